// Changes to packed worlds between two steps: blocks of cells set, whole worlds replaced. Comes after the views.

// Where row y of a world lies: its lane, and the row there.
struct Place {
  Group& group;
  int lane, row;
};
static Place place_of(Batch& b, int world, int y) {
  int lane = b.g.strips ? world * LANES + y / b.g.height : world;
  return Place{b.groups[lane / LANES], lane % LANES, b.g.strips ? y % b.g.height : y};
}
// Some bits of a word of a plane; true if that changes it. A plane known to hold nothing may have anything in memory.
ALWAYS bool set_bits(const Grid& g, Plane* p, const Place& at, int w, u64 mask, u64 wanted) {
  if (p->zero) {
    if (!wanted) return false;
    memset(p->data, 0, sizeof(V) * g.cells());
    p->zero = false;
  }
  u64& word = ((u64*)p->data)[(at.row * g.words + w) * LANES + at.lane];
  bool changes = (word ^ wanted) & mask;
  word = (word & ~mask) | wanted;
  p->around = p->beyond = 0;
  return changes;
}
static u64 bits_between(int from, int to) {  // of a word; to > from
  return (to >= 64 ? ~0ull : (1ull << to) - 1) & ~0ull << std::max(from, 0);
}

struct Block {
  int32_t top, bottom, left, right;  // rows and columns; the last ones are not in it. Empty if bottom <= top.
};
// One number for a slot in each world's block.
API void pd_fill(void* batch, int slot, int bits, const Block* blocks, const int32_t* values) {
  Batch& b = *(Batch*)batch;
  for (int world = 0; world < b.worlds; world++) {
    const Block& k = blocks[world];
    for (int y = k.top; y < k.bottom; y++) {
      Place at = place_of(b, world, y);
      for (int w = k.left / 64; w * 64 < k.right; w++) {
        u64 mask = bits_between(k.left - 64 * w, k.right - 64 * w);
        for (int i = 0; i < bits; i++)
          set_bits(b.g, at.group.slot[slot + i], at, w, mask, values[world] >> i & 1 ? mask : 0);
      }
    }
  }
}
// How many cells of each world's block do not hold a number.
API void pd_count_others(void* batch, int slot, int bits, const Block* blocks, const int32_t* values, int64_t* counts) {
  Batch& b = *(Batch*)batch;
  for (int world = 0; world < b.worlds; world++) {
    const Block& k = blocks[world];
    counts[world] = 0;
    for (int y = k.top; y < k.bottom; y++) {
      Place at = place_of(b, world, y);
      for (int w = k.left / 64; w * 64 < k.right; w++) {
        u64 differs = 0;
        for (int i = 0; i < bits; i++)
          differs |= word_of(at.group.slot[slot + i], at.lane, at.row * b.g.words + w) ^ (values[world] >> i & 1 ? ~0ull : 0);
        counts[world] += __builtin_popcountll(differs & bits_between(k.left - 64 * w, k.right - 64 * w));
      }
    }
  }
}
static void settle_row(const Context& c, Field* f, const Place& at, float* row) {  // after its cells were written
  bool some = std::any_of(row, row + c.g.width, [](float v) { return v != 0; });
  f->live[at.lane * c.g.height + at.row] = some;
  if (some) f->still = false;
  finish_row(c, row);
}
API void pd_fill_real(void* batch, int slot, const Block* blocks, const float* values) {
  Batch& b = *(Batch*)batch;
  Context* c = borrow(b.g);
  for (int world = 0; world < b.worlds; world++)
    for (int y = blocks[world].top; y < blocks[world].bottom; y++) {
      Place at = place_of(b, world, y);
      Field* f = at.group.real[slot];
      float* row = row_of(*c, f, at.lane, at.row);
      if (!f->live[at.lane * b.g.height + at.row]) memset(row, 0, sizeof(float) * b.g.width);
      std::fill(row + blocks[world].left, row + blocks[world].right, values[world]);
      settle_row(*c, f, at, row);
    }
  put_back(c);
}

// Worlds replaced: number `places[i]` of the batch by number i of `data`.
template <class T> static void put_values(Batch& b, int slot, int bits, const T* data, int count, const int64_t* places) {
  const Grid& g = b.g;
  for (int i = 0; i < count; i++)
    for (int y = 0; y < g.world_height(); y++) {
      Place at = place_of(b, (int)places[i], y);
      for (int w = 0; w < g.words; w++) {
        int run = std::min(64, g.width - 64 * w);
        for (int k = 0; k < bits; k++) {
          u64 word = 0;
          for (int x = 0; x < run; x++) word |= (u64)((u64)data[x] >> k & 1) << x;
          set_bits(g, at.group.slot[slot + k], at, w, ~0ull, word);
        }
        data += run;
      }
    }
}
API void pd_put(void* batch, int slot, int bits, int item, const void* data, int count, const int64_t* places) {
  Batch& b = *(Batch*)batch;
  if (item == 1) put_values(b, slot, bits, (const uint8_t*)data, count, places);
  else if (item == 2) put_values(b, slot, bits, (const int16_t*)data, count, places);
  else put_values(b, slot, bits, (const int32_t*)data, count, places);
}
API void pd_put_real(void* batch, int slot, const float* data, int64_t apart, int count, const int64_t* places) {
  Batch& b = *(Batch*)batch;
  Context* c = borrow(b.g);
  for (int i = 0; i < count; i++)
    for (int y = 0; y < b.g.world_height(); y++) {
      Place at = place_of(b, (int)places[i], y);
      Field* f = at.group.real[slot];
      float* row = row_of(*c, f, at.lane, at.row);
      memcpy(row, data + i * apart + (int64_t)y * b.g.width, sizeof(float) * b.g.width);
      settle_row(*c, f, at, row);
    }
  put_back(c);
}
