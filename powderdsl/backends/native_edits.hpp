// Worlds of a packed batch replaced between two steps. Comes after the views.

// Where row y of a world lies: its lane, and the row there.
struct Place {
  Group& group;
  int lane, row;
};
static Place place_of(Batch& b, int world, int y) {
  int lane = b.g.strips ? world * LANES + y / b.g.height : world;
  return Place{b.groups[lane / LANES], lane % LANES, b.g.strips ? y % b.g.height : y};
}
ALWAYS void set_word(const Grid& g, Plane* p, const Place& at, int w, u64 word) {
  if (p->zero) {  // then its memory may hold anything
    if (!word) return;
    memset(p->data, 0, sizeof(V) * g.cells());
    p->zero = false;
  }
  ((u64*)p->data)[(at.row * g.words + w) * LANES + at.lane] = word;
  p->around = p->beyond = 0;
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
          set_word(g, at.group.slot[slot + k], at, w, word);
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
      bool some = std::any_of(row, row + b.g.width, [](float v) { return v != 0; });
      f->live[at.lane * b.g.height + at.row] = some;
      if (some) f->still = false;
      finish_row(*c, row);
    }
  put_back(c);
}
