// Rows of reals, and the rows of planes that they ask for. Comes after planes.hpp.

// Real rows.
ALWAYS const float* real_line(const Context& c, const Field* f, int line) {
  return f->live[line] ? f->data + (size_t)line * c.g.stride + HALO : c.zeros + HALO;
}
ALWAYS const float* real_row(const Context& c, const Field* f, int lane, int y) {
  return real_line(c, f, lane * c.g.height + y);
}
ALWAYS const float* real_row_wrapped(const Context& c, const Field* f, int lane, int y) {
  return real_line(c, f, c.line(lane, y));
}
ALWAYS const float* real_row_or_nothing(const Context& c, const Field* f, int lane, int y) {
  return c.has_line(lane, y) ? real_line(c, f, lane * c.g.height + y) : c.zeros + HALO;
}
ALWAYS F inside_columns(F value, int x, int dx, int width) {
  if (__builtin_expect(x + dx >= 0 && x + dx + CHUNK <= width, 1)) return value;
  const I number = NUMBERS;
  I at = number + (x + dx);
  return (F)((I)value & (at >= 0) & (at < width));
}
ALWAYS F load(const float* row, int x) { return (F)*(const Fu*)(row + x); }
// All columns of a world's row together.
ALWAYS u64 row_bits(const Plane* p, int first, int words, int lane) {
  u64 some = 0;
  for (int w = 0; w < words; w++) some |= ((const u64*)p->data)[(first + w) * LANES + lane];
  return some;
}
static void close_plane(const Context& c, Plane* p) {  // nothing beyond the width; and is there anything at all?
  V some = splat(0);
  for (int y = 0, i = 0; y < c.g.height; y++)
    for (int w = 0; w < c.g.words; w++, i++) some |= p->data[i] &= c.valid(w);
  p->zero = !any(some);
}
// Which rows of which world a plane has cells in.
OUTLINE void active_rows(Context& c, const Plane* p, int list) {
  const int many = c.active_words();
  u64* out = c.active + (size_t)list * LANES * many;
  memset(out, 0, sizeof(u64) * LANES * many);
  if (p->zero) return;
  for (int first = 0; first < c.g.height; first += 64) {
    alignas(64) uint8_t worlds[64] = {};  // a bit for each world
    for (int y = first; y < first + 64 && y < c.g.height; y++) {
      V some = p->data[y * c.g.words];
      for (int w = 1; w < c.g.words; w++) some |= p->data[y * c.g.words + w];
      worlds[y - first] = lanes_of(some);
    }
    for (int l = 0; l < LANES; l++) {
#if defined(__AVX512BW__)
      out[l * many + first / 64] = _mm512_test_epi8_mask(_mm512_load_si512(worlds), _mm512_set1_epi8((char)(1 << l)));
#elif VECTOR == 32
      for (int half = 0; half < 2; half++) {
        const __m256i flag = _mm256_slli_epi16(_mm256_load_si256((const __m256i*)worlds + half), 7 - l);
        out[l * many + first / 64] |= (u64)(u32)_mm256_movemask_epi8(flag) << 32 * half;
      }
#else
      for (int i = 0; i < 64; i++) out[l * many + first / 64] |= (u64)(worlds[i] >> l & 1) << i;
#endif
    }
  }
}
static void active_together(Context& c, int first, int count) {  // into the list behind them
  const size_t size = (size_t)LANES * c.active_words();
  u64 *lists = c.active + first * size, *all = lists + count * size;
  for (size_t i = 0; i < size; i++) {
    all[i] = 0;
    for (int k = 0; k < count; k++) all[i] |= lists[k * size + i];
  }
}
ALWAYS bool is_active(const Context& c, int list, int lane, int y) {
  return c.active[((size_t)list * LANES + lane) * c.active_words() + y / 64] >> (y & 63) & 1;
}
#define EACH_ACTIVE(list) /* of the near rows that begin at `from` */ \
  for (u32 rest = c.active[((size_t)(list) * LANES + l) * c.active_words() + from / 64] >> (from & 63) & c.near_bits; rest; rest &= rest - 1) \
    if (const int y = from + __builtin_ctz(rest); true)
// Sweeps over the rows of lanes, one after the other. In strips, a sweep follows the one before it two blocks later: a
// block is computed from blocks of the sweep before that are next to it, around the edge of the strips, and so finds them
// in a near cache. Each begins a block further on, and comes around to its first blocks at the end.
#define EACH_BLOCK(last_part) \
  for (int blocks = std::max(1, height / c.block), round = 0; round < blocks + (2 * (last_part) & strips); round++) \
    for (int part = 0; part <= ((last_part) & strips); part++) \
      if (const int done = round - 2 * part, block = (done + part) % blocks; done >= 0 && done < blocks) \
        if (const int first = block * c.block, last = block == blocks - 1 ? height : first + c.block; true)
// Chunks of the columns in word w, and which of a chunk's columns lie in the grid.
#define EACH_CHUNK for (int x = 64 * w; x < 64 * w + 64 && (WORDS || x < width); x += CHUNK)
ALWAYS u32 inside_of(int x, int width) { return WORDS || width - x >= CHUNK ? ALL : (1u << (width - x)) - 1; }
// The flags of a chunk, into one world's word, which is kept little end first.
ALWAYS void put_bits(u64* word, int x, u32 bits) {
#if __BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__
  if constexpr (CHUNK >= 8) {
    memcpy((char*)word + (x & 63) / 8, &bits, CHUNK / 8);
    return;
  }
#endif
  const int by = x & 63;
  *word = (*word & ~((u64)ALL << by)) | (u64)bits << by;
}
// After the chunks of a row: nothing beyond the width, then the halo.
ALWAYS void finish_row(const Context& c, float* row) {
  int w = c.g.width;
  if (__builtin_expect(w >= REACH, 1)) {
    for (int i = 0; i < REACH; i++) row[w + i] = row[i];
    for (int i = 1; i <= REACH; i++) row[-i] = row[w - i];
  } else {
    for (int i = 0; i < REACH; i++) row[w + i] = row[i % w];
    for (int i = 1; i <= REACH; i++) row[-i] = row[(w - i % w) % w];
  }
}

ALWAYS float* row_of(const Context& c, const Field* f, int lane, int y) {
  return f->data + ((size_t)lane * c.g.height + y) * c.g.stride + HALO;
}
static void copy_floats(const Grid& g, float* to, const float* from) {  // a row and its halo
  memcpy(to - REACH, from - REACH, sizeof(float) * (g.width + 2 * REACH));
}
// A row that choices will be laid over, or that stays as it is; whether it is live.
ALWAYS bool lay_row(const Context& c, Field* to, int to_lane, const Field* from, int from_lane, int y, bool chosen) {
  const bool live = chosen || from->live[from_lane * c.g.height + y];
  to->live[to_lane * c.g.height + y] = live;
  if (!live) return false;
  float* out = row_of(c, to, to_lane, y);
  const float* in = real_row(c, from, from_lane, y);
  for (int x = 0; x < c.g.width; x += CHUNK) *(F*)(out + x) = load(in, x);
  if (!chosen) finish_row(c, out);
  return true;
}
ALWAYS bool copy_row(const Context& c, Field* to, const Field* from, int lane, int y) {
  size_t at = lane * (size_t)c.g.height + y;
  to->live[at] = from->live[at];
  if (from->live[at]) copy_floats(c.g, row_of(c, to, lane, y), row_of(c, from, lane, y));
  return from->live[at];
}
