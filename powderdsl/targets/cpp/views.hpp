// What packed worlds show: values of cells, pictures, channels, and the planes themselves, written straight into the
// caller's memory. `apart` is the distance from one world to the next there, in items. Comes after the driver.

ALWAYS u64 word_of(const Plane* p, int lane, int i) { return p->zero ? 0 : ((const Word*)p->data)[i * LANES + lane]; }

// Flags as bytes 0 and 1: eight of them by a table, sixty-four at once where the machine can.
struct Spread {
  u64 of[256];
  constexpr Spread() : of() {
    for (int b = 0; b < 256; b++)
      for (int i = 0; i < 8; i++) of[b] |= (u64)(b >> i & 1) << 8 * i;
  }
};
static constexpr Spread SPREAD;
// The sum of up to eight planes by weight, as 64 bytes.
ALWAYS void bytes_of(const u64* words, const uint8_t* weights, int count, uint8_t* out) {
#if defined(__AVX512BW__)
  __m512i sum = _mm512_setzero_si512();
  for (int i = 0; i < count; i++) sum = _mm512_mask_add_epi8(sum, words[i], sum, _mm512_set1_epi8((char)weights[i]));
  _mm512_storeu_si512(out, sum);
#else
  for (int part = 0; part < 8; part++) {
    u64 sum = 0;
    for (int i = 0; i < count; i++) sum |= SPREAD.of[words[i] >> 8 * part & 255] * weights[i];
    memcpy(out + 8 * part, &sum, 8);
  }
#endif
}

// The planes of a slot of whole numbers; the last may be a sign, which counts in all higher bits too.
struct Planes {
  const Plane* const* plane;
  int bits;
  bool negative;
};
static Planes planes_of(const Group& group, int slot, int bits, int negative) {
  return Planes{group.slot + slot, bits, negative != 0};
}
// 64 cells from word i of a world, eight planes a byte.
template <class T> ALWAYS void cells_of(const Planes& p, int lane, int i, T* out) {
  uint8_t bytes[sizeof(T)][64];
  for (int part = 0; part < (int)sizeof(T); part++) {
    u64 words[8];
    uint8_t weights[8];
    int first = 8 * part, count = std::min(8, p.bits - first);
    for (int k = 0; k < count; k++) {
      words[k] = word_of(p.plane[first + k], lane, i);
      weights[k] = 1 << k;
    }
    if (p.negative && count <= 0) {
      words[0] = word_of(p.plane[p.bits - 1], lane, i);
      weights[0] = 255;
      count = 1;
    } else if (p.negative && first + count == p.bits) {
      weights[count - 1] = -(1 << (count - 1));
    }
    bytes_of(words, weights, std::max(count, 0), bytes[part]);
  }
  if constexpr (sizeof(T) == 1) {
    memcpy(out, bytes[0], 64);
  } else {
    for (int x = 0; x < 64; x++) {
      T value = 0;
      for (int part = 0; part < (int)sizeof(T); part++) value |= (T)bytes[part][x] << 8 * part;
      out[x] = value;
    }
  }
}

// Calls `put(word, cell, count)` for the columns of each word of a world, from the top left.
template <class Put> ALWAYS void each_run(const Grid& g, Put put) {
  for (int y = 0; y < g.height; y++)
    for (int w = 0; w < g.words; w++) put(y * g.words + w, y * g.width + BITS * w, std::min(BITS, g.width - BITS * w));
}
// The lanes of some worlds.
struct Lanes {
  int first, last;
};
static Lanes lanes_of(const Batch& b, int first, int last) {
  return Lanes{first * b.g.strips, last * b.g.strips};
}
template <class T> static void store_values(const Batch& b, Lanes some, int slot, int bits, int negative, T* data, int64_t apart) {
  for (int lane = some.first; lane < some.last; lane++) {
    Planes p = planes_of(b.groups[lane / LANES], slot, bits, negative);
    T* out = data + b.at(lane, apart, b.g.width);
    each_run(b.g, [&](int i, int cell, int count) {
      if (count == 64) return cells_of(p, lane % LANES, i, out + cell);
      T part[64];
      cells_of(p, lane % LANES, i, part);
      memcpy(out + cell, part, sizeof(T) * count);
    });
  }
}
static void store_real(const Grid& g, const Field* f, int lane, float* out);
static void store(const Batch& b, Lanes some, int slot, int bits, int negative, int item, void* data, int64_t apart) {
  for (int lane = some.first; !bits && lane < some.last; lane++)
    store_real(b.g, b.groups[lane / LANES].real[slot], lane % LANES, (float*)data + b.at(lane, apart, b.g.width));
  if (!bits) return;
  if (item == 1) store_values(b, some, slot, bits, negative, (uint8_t*)data, apart);
  else if (item == 2) store_values(b, some, slot, bits, negative, (uint16_t*)data, apart);
  else store_values(b, some, slot, bits, negative, (u32*)data, apart);
}
API void pd_store(const void* batch, int slot, int bits, int negative, int item, void* data, int64_t apart) {
  const Batch& b = *(const Batch*)batch;
  store(b, lanes_of(b, 0, b.worlds), slot, bits, negative, item, data, apart);
}

// The colors of up to 64 cells whose ids have some bits. The palette has 256 colors.
ALWAYS void colors_of(const uint8_t* ids, int bits, int count, const u32* palette, u32* out) {
#if defined(__AVX512F__)
  if (bits <= 5) {
    const __m512i low = _mm512_loadu_si512(palette), high = _mm512_loadu_si512(palette + 16);
    for (int x = 0; x < count; x += 16) {
      const __m512i index = _mm512_cvtepu8_epi32(_mm_loadu_si128((const __m128i*)(ids + x)));
      _mm512_mask_storeu_epi32(out + x, 0xffff >> std::max(0, 16 - (count - x)), _mm512_permutex2var_epi32(low, index, high));
    }
    return;
  }
#endif
  for (int x = 0; x < count; x++) out[x] = palette[ids[x]];
}
// Pictures of one lane, row by row: red, green and blue of each cell in the three low bytes, 0 in the high one.
static void paint_ids(const Batch& b, int lane, int slot, int bits, const u32* palette, u32* picture) {
  Planes p = planes_of(b.groups[lane / LANES], slot, bits, 0);
  each_run(b.g, [&](int i, int cell, int count) {
    uint8_t ids[64];
    cells_of(p, lane % LANES, i, ids);
    colors_of(ids, bits, count, palette, picture + cell);
  });
}

// A field of reals of a world.
static void store_real(const Grid& g, const Field* f, int lane, float* out) {
  for (int y = 0; y < g.height; y++, out += g.width) {
    size_t row = (size_t)lane * g.height + y;
    if (f->live[row]) memcpy(out, f->data + row * g.stride + HALO, sizeof(float) * g.width);
    else memset(out, 0, sizeof(float) * g.width);
  }
}

// Cells of the element `id` in pictures, in the color of their field: row k of `colors` for values that reach k of the
// ascending `starts`.
template <class T, class Values>
ALWAYS void ramp_world(const Planes& ids, int id, int lane, const Grid& g, const T* starts, int count, const u32* colors, u32* picture, Values values_of) {
  each_run(g, [&](int i, int cell, int cells) {
    uint8_t found[64];
    cells_of(ids, lane, i, found);
    if (!memchr(found, id, cells)) return;
    const T* values = values_of(i, cell);
    for (int x = 0; x < cells; x++)
      if (found[x] == id) picture[cell + x] = colors[std::upper_bound(starts, starts + count, values[x]) - starts];
  });
}
static void paint_ramp(const Batch& b, int lane, int slot, int bits, int id, int is_real, int field, int field_bits, int negative, int count,
                  const void* starts, const u32* colors, u32* picture) {
  const Grid& g = b.g;
  const Group& group = b.groups[lane / LANES];
  Planes ids = planes_of(group, slot, bits, 0);
  if (is_real) {
    std::vector<float> row((size_t)g.height * g.width);
    store_real(g, group.real[field], lane % LANES, row.data());
    ramp_world(ids, id, lane % LANES, g, (const float*)starts, count, colors, picture, [&](int, int cell) { return row.data() + cell; });
  } else {
    Planes values = planes_of(group, field, field_bits, negative);
    int32_t part[64];
    ramp_world(ids, id, lane % LANES, g, (const int32_t*)starts, count, colors, picture, [&](int i, int) {
      cells_of(values, lane % LANES, i, (u32*)part);
      return (const int32_t*)part;
    });
  }
}

// Cells in pictures, tinted by vectors: toward a color in 0..1, by the length / `full`, at most by `most`. `numbers` has the
// color, `full` and `most`. As `tint_cells` in simulation/draw.py, operation by operation.
static void paint_tint(const Batch& b, int lane, int row, int column, const float* numbers, u32* picture) {
  const Grid& g = b.g;
  const F full = splatf(numbers[3]), most = splatf(numbers[4]);
  const std::vector<float> nothing(g.stride + CHUNK, 0.f);
  const Field* parts[2] = {b.groups[lane / LANES].real[row], b.groups[lane / LANES].real[column]};
  for (int y = 0; y < g.height; y++, picture += g.width) {
    const size_t line = (size_t)(lane % LANES) * g.height + y;
    const float* in[2];
    for (int k = 0; k < 2; k++) in[k] = parts[k]->live[line] ? parts[k]->data + line * g.stride + HALO : nothing.data();
    if (in[0] == in[1]) continue;  // both are zero
    for (int x = 0; x < g.width; x += CHUNK) {
      const F down = load(in[0], x), right = load(in[1], x);
      const F square = down * down + right * right;
      if (!bits_lt(splatf(0), square)) continue;
      const F share = smaller(root(square) / full, most), rest = 1.0f - share;
      const size_t bytes = sizeof(u32) * std::min(CHUNK, g.width - x);
      U before{}, after{};
      memcpy(&before, picture + x, bytes);
#pragma GCC unroll 3
      for (int c = 0; c < 3; c++) {
        const F part = __builtin_convertvector((I)(before >> 8 * c & 255u), F);
        after |= (U)__builtin_convertvector((part / 255.f * rest + share * numbers[c]) * 255.f, I) << 8 * c;
      }
      memcpy(picture + x, &after, bytes);
    }
  }
}

// Channels of float32.
struct Channel {
  int kind;  // 0 nothing, 1 cells of a number, 2 what a table says of a number, 3 a number, 4 a real
  int slot, bits;
  int value;  // the number, the table, or whether the last plane is a sign
};
ALWAYS void put_floats(float* out, u64 word, int count) {  // flags as 0 and 1
  float part[64], *to = count == 64 ? out : part;
  for (int x = 0; x < 64; x += CHUNK) *(Fu*)(to + x) = (Fu)blend(word >> x & ALL, splatf(1), splatf(0));
  if (count < 64) memcpy(out, part, sizeof(float) * count);
}
static void store_channel(const Batch& b, const Channel& c, const float* tables, int number, float* out) {
  const Group& group = b.groups[number / LANES];
  int lane = number % LANES;
  if (c.kind == 0) {
    memset(out, 0, sizeof(float) * b.g.height * b.g.width);
  } else if (c.kind == 4) {
    store_real(b.g, group.real[c.slot], lane, out);
  } else if (c.kind == 1) {
    each_run(b.g, [&](int i, int cell, int count) {
      u64 word = ~0ull;
      for (int k = 0; k < c.bits; k++) {
        u64 plane = word_of(group.slot[c.slot + k], lane, i);
        word &= c.value >> k & 1 ? plane : ~plane;
      }
      put_floats(out + cell, word, count);
    });
  } else if (c.kind == 2) {
    Planes p = planes_of(group, c.slot, c.bits, 0);
    each_run(b.g, [&](int i, int cell, int count) {
      uint8_t ids[64];
      cells_of(p, lane, i, ids);
      for (int x = 0; x < count; x++) out[cell + x] = tables[256 * c.value + ids[x]];
    });
  } else {
    Planes p = planes_of(group, c.slot, c.bits, c.value);
    each_run(b.g, [&](int i, int cell, int count) {
      int32_t part[64];
      cells_of(p, lane, i, (u32*)part);
      for (int x = 0; x < count; x++) out[cell + x] = (float)part[x];
    });
  }
}
static void show_channels(const Batch& b, Lanes some, int count, const Channel* channels, const float* tables, float* data, int64_t apart) {
  for (int lane = some.first; lane < some.last; lane++)
    for (int i = 0; i < count; i++)
      store_channel(b, channels[i], tables, lane, data + b.at(lane, apart, b.g.width) + (int64_t)i * b.g.world_height() * b.g.width);
}

typedef uint8_t Bytes __attribute__((vector_size(CHUNK), may_alias));
// Reals in eight bits: 128 is 0, further from it in steps that grow with the value. `floor` is a power of two.
ALWAYS void codes_of(const float* in, int count, float floor, uint8_t* out) {  // reads up to a whole chunk
  int32_t least;
  memcpy(&least, &floor, 4);
  for (int x = 0; x < count; x += CHUNK) {
    F value = (F)*(const Fu*)(in + x);
    I bits = (I)value, sign = bits >> 31;
    I size = ((I)((F)(bits & 0x7fffffff) + floor) - least + (1 << 19)) >> 20;
    Bytes codes = __builtin_convertvector(((size ^ sign) - sign) + 128, Bytes);
    memcpy(out + x, &codes, std::min(CHUNK, count - x));
  }
}
static void show_codes(const Batch& b, Lanes some, int slot, int bits, int negative, float floor, uint8_t* data, int64_t apart) {
  for (int lane = some.first; lane < some.last; lane++) {
    const Group& group = b.groups[lane / LANES];
    uint8_t* out = data + b.at(lane, apart, b.g.width);
    if (bits) {
      Planes p = planes_of(group, slot, bits, negative);
      each_run(b.g, [&](int i, int cell, int count) {
        int32_t numbers[64];
        float values[64];
        cells_of(p, lane % LANES, i, (u32*)numbers);
        std::copy_n(numbers, 64, values);
        codes_of(values, count, floor, out + cell);
      });
      continue;
    }
    const Field* f = group.real[slot];
    for (int y = 0; y < b.g.height; y++, out += b.g.width) {
      size_t row = (size_t)(lane % LANES) * b.g.height + y;
      if (f->live[row]) codes_of(f->data + row * b.g.stride + HALO, b.g.width, floor, out);  // rows go on behind the last column
      else memset(out, 128, b.g.width);
    }
  }
}

// Planes as they are: [plane][row][word] of each world.
static void show_planes(const Batch& b, Lanes some, int count, const int* slots, u64* data, int64_t apart) {
  for (int lane = some.first; lane < some.last; lane++)
    for (int k = 0; k < count; k++) {
      const Plane* p = b.groups[lane / LANES].slot[slots[k]];
      u64* out = data + b.at(lane, apart, b.g.words) + (int64_t)k * b.g.world_height() * b.g.words;
      for (int i = 0; i < b.g.cells(); i++) out[i] = word_of(p, lane % LANES, i);
    }
}

// One part of an observation: what is shown, from the byte `offset` of each world's memory on.
struct View {
  int kind;  // 0 the values of a slot less a[4], 1 colors, 2 a ramp, 3 a tint, 4 channels, 5 codes of reals, 6 planes
  int a[9];
  float number;  // a floor, or the bytes of a pixel, from 3 to 8: red, green, blue, then zeros
  const void *first, *second;
  int64_t offset;
};
// `apart`: bytes from one world's memory to the next's. A picture is painted by all views.
static void show_picture(const Batch& b, Lanes some, const View* views, int count, uint8_t* out, int64_t apart) {
  const int cells = b.g.height * b.g.width, size = (int)views->number;
  std::vector<u32> picture(cells);
  for (int lane = some.first; lane < some.last; lane++) {
    for (const View* v = views; v < views + count; v++) {
      const int* a = v->a;
      const u32* colors = (const u32*)v->first;
      if (v->kind == 1) paint_ids(b, lane, a[0], a[1], colors, picture.data());
      else if (v->kind == 2) paint_ramp(b, lane, a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], v->second, colors, picture.data());
      else paint_tint(b, lane, a[0], a[1], (const float*)v->first, picture.data());
    }
    uint8_t* pixel = out + views->offset + b.at(lane, apart, size * b.g.width);
    const u32 *color = picture.data(), *end = color + cells;
#pragma GCC unroll 4
    for (; color < end - 2; color++, pixel += size) {
      const u64 bytes = *color;
      memcpy(pixel, &bytes, 8);  // the next mend what is too much
    }
    for (; color < end; color++, pixel += size) {
      const u64 bytes = *color;
      memcpy(pixel, &bytes, size);
    }
  }
}
static void show_view(const Batch& b, Lanes some, const View& v, uint8_t* out, int64_t apart) {
  const int* a = v.a;
  uint8_t* data = out + v.offset;
  switch (v.kind) {
    case 0:
      store(b, some, a[0], a[1], a[2], a[3], data, apart / a[3]);
      for (int lane = some.first; a[4] && lane < some.last; lane++) {
        uint8_t* cell = data + b.at(lane, apart, b.g.width);
        for (int i = 0; i < b.g.height * b.g.width; i++) cell[i] -= a[4];
      }
      return;
    case 4: return show_channels(b, some, a[0], (const Channel*)v.first, (const float*)v.second, (float*)data, apart / 4);
    case 5: return show_codes(b, some, a[0], a[1], a[2], v.number, data, apart);
    default: return show_planes(b, some, a[0], (const int*)v.first, (u64*)data, apart / 8);
  }
}
static void show(const Batch& b, Lanes some, const View* views, int count, uint8_t* out, int64_t apart) {
  if (count && views->kind == 1) return show_picture(b, some, views, count, out, apart);
  for (int i = 0; i < count; i++) show_view(b, some, views[i], out, apart);
}
API void pd_show(const void* batch, int count, const View* views, uint8_t* out, int64_t apart) {
  const Batch& b = *(const Batch*)batch;
  show(b, lanes_of(b, 0, b.worlds), views, count, out, apart);
}

// Numbers of cells where masks hold. A gate is a plane of the batch, a mask, or an operation on earlier gates. Masks are
// [mask][rows of a world][words], `apart` words from one world's to the next's; 0 if all worlds share them.
struct Gate {
  int op, a, b;  // 0 plane, 1 mask, 2 not, 3 and, 4 or, 5 xor, 6 nothing
};
struct Count {
  int gate, number, highest;  // of the measure that its cells count for, or that their greatest height is
  double weight;
};
struct Counts {
  int gates, counts, numbers, top, bottom;  // rows to count
  const Gate* gate;
  const Count* count;
};
static V mask_row(const Batch& b, const u64* mask, int64_t apart, int n, int y, int w) {
  const Grid& g = b.g;
  if (g.strips == 1 && !apart) return splat(mask[(size_t)y * g.words + w]);
  V row = splat(0);
  for (int l = 0; l < LANES; l++) {
    const int64_t world = std::min((n * LANES + l) / g.strips, b.worlds - 1);
    row[l] = mask[world * apart + ((size_t)(l % g.strips) * g.height + y) * g.words + w];
  }
  return row;
}
// `values` is [world][numbers]; `sizes`, which numbers are divided by, likewise, `sizes_apart` from world to world.
static void count_cells(const Batch& b, const Counts& c, const u64* masks, int64_t apart, const double* sizes, int64_t sizes_apart, double* values) {
  const Grid& g = b.g;
  const size_t mask_words = (size_t)g.world_height() * g.words;
  const int first = g.strips > 1 ? 0 : c.top, last = g.strips > 1 ? g.height : c.bottom, rest = g.width - BITS * (g.words - 1);
  const V whole = splat(FULL), edge = splat(FULL >> (BITS - rest));
  V* value = aligned<V>(c.gates + 1);
  std::vector<int64_t> total((size_t)c.counts * LANES);
  for (int i = 0; i < b.worlds; i++)
    for (int k = 0; k < c.counts; k++) values[(size_t)i * c.numbers + c.count[k].number] = 0;
  for (int n = 0; n < (int)b.groups.size(); n++) {
    if (b.rests(n)) continue;
    std::fill(total.begin(), total.end(), 0);
    for (int i = first * g.words; i < last * g.words; i++) {
      const int y = i / g.words, w = i % g.words;
      for (int k = 0; k < c.gates; k++) {
        const int a = c.gate[k].a, d = c.gate[k].b;
        switch (c.gate[k].op) {
          case 0: value[k] = b.groups[n].slot[a]->zero ? splat(0) : b.groups[n].slot[a]->data[i]; break;
          case 1: value[k] = mask_row(b, masks + a * mask_words, apart, n, y, w); break;
          case 2: value[k] = ~value[a]; break;
          case 3: value[k] = value[a] & value[d]; break;
          case 4: value[k] = value[a] | value[d]; break;
          case 5: value[k] = value[a] ^ value[d]; break;
          default: value[k] = splat(0);
        }
      }
      for (int k = 0; k < c.counts; k++) {
        const V cells = value[c.count[k].gate] & (w == g.words - 1 ? edge : whole);
        for (int l = 0; l < LANES; l++) {
          int64_t& sum = total[(size_t)k * LANES + l];
          if (!c.count[k].highest) sum += __builtin_popcountll(cells[l]);
          else if (cells[l]) sum = std::max<int64_t>(sum, g.world_height() - (l % g.strips * g.height + y));
        }
      }
    }
    for (int k = 0; k < c.counts; k++)
      for (int l = 0; l < LANES; l++) {
        const int lane = n * LANES + l;
        if (lane >= b.lanes()) break;
        double& sum = values[(size_t)(lane / g.strips) * c.numbers + c.count[k].number];
        const double part = c.count[k].weight * (double)total[(size_t)k * LANES + l];
        sum = c.count[k].highest ? std::max(sum, part) : sum + part;
      }
  }
  std::vector<char> divided(c.numbers);
  for (int k = 0; k < c.counts; k++) {
    const int number = c.count[k].number;
    if (divided[number]++) continue;
    for (int i = 0; i < b.worlds; i++) values[(size_t)i * c.numbers + number] /= sizes[i * sizes_apart + number];
  }
  free(value);
}
API void pd_count(const void* batch, const Counts* counts, const u64* masks, int64_t apart, const double* sizes, int64_t sizes_apart, double* values) {
  count_cells(*(const Batch*)batch, *counts, masks, apart, sizes, sizes_apart, values);
}
