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
// Masks of choices, lane by lane: [LANES][rows of a block][words][c.masks], so that a lane finds the words of all masks side by side.
ALWAYS void turn(const V* in, V* out) {  // LANES vectors of LANES words
#if VECTOR == 64
  const __m512i low[3] = {
      _mm512_setr_epi64(0, 8, 2, 10, 4, 12, 6, 14), _mm512_setr_epi64(0, 1, 8, 9, 4, 5, 12, 13), _mm512_setr_epi64(0, 1, 2, 3, 8, 9, 10, 11)};
  const __m512i high[3] = {
      _mm512_setr_epi64(1, 9, 3, 11, 5, 13, 7, 15), _mm512_setr_epi64(2, 3, 10, 11, 6, 7, 14, 15), _mm512_setr_epi64(4, 5, 6, 7, 12, 13, 14, 15)};
  __m512i rows[8];
  _Pragma("GCC unroll 8") for (int i = 0; i < 8; i++) rows[i] = (__m512i)in[i];
  _Pragma("GCC unroll 3") for (int s = 0; s < 3; s++)  // pairs of rows, then of pairs, then of fours
    _Pragma("GCC unroll 8") for (int i = 0; i < 8; i++)
      if (!(i >> s & 1)) {
        const __m512i a = rows[i], b = rows[i | 1 << s];
        rows[i] = _mm512_permutex2var_epi64(a, low[s], b);
        rows[i | 1 << s] = _mm512_permutex2var_epi64(a, high[s], b);
      }
  _Pragma("GCC unroll 8") for (int i = 0; i < 8; i++) out[i] = (V)rows[i];
#else
  for (int i = 0; i < LANES; i++)
    for (int l = 0; l < LANES; l++) out[l][i] = in[i][l];
#endif
}
OUTLINE void turn_masks(Context& c, const Plane* const* planes, int count, int place, int first, int last) {
  const int begin = first * c.g.words, cells = (last - first) * c.g.words;
  const size_t apart = (size_t)c.most_rows() * c.g.words * c.masks;
  for (int i = 0; i < cells; i++)
    for (int from = 0; from < count; from += LANES) {
      V in[LANES], out[LANES];
      for (int k = 0; k < LANES; k++) in[k] = from + k < count ? planes[from + k]->data[begin + i] : splat(0);
      turn(in, out);
      for (int l = 0; l < c.lanes; l++) *(V*)(c.turned + l * apart + (size_t)i * c.masks + place + from) = out[l];
    }
}
ALWAYS const u64* turned_row(const Context& c, int lane, int y) {
  return c.turned + ((size_t)lane * c.most_rows() + y) * c.g.words * c.masks;
}
ALWAYS bool any_turned(const Context& c, const u64* masks, int count) {
  V some = splat(0);
  for (int w = 0; w < c.g.words; w++)
    for (int from = 0; from < count; from += LANES) some |= *(const V*)(masks + w * c.masks + from);
  return any(some);
}
// The chunks of word w, whose values wait in registers.
#define EACH_REGISTER _Pragma("GCC unroll 16") for (int k = 0, x = 64 * w; k < 64 / CHUNK && (WORDS || x < width); k++, x += CHUNK)
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
// After the chunks of a row: the halo, as far as columns are read beyond the edges.
template <int FAR = REACH> ALWAYS void finish_row(const Context& c, float* row) {
  int w = c.g.width;
  if (__builtin_expect(w >= FAR, 1)) {
    for (int i = 0; i < FAR; i++) row[w + i] = row[i];
    for (int i = 1; i <= FAR; i++) row[-i] = row[w - i];
  } else {
    for (int i = 0; i < FAR; i++) row[w + i] = row[i % w];
    for (int i = 1; i <= FAR; i++) row[-i] = row[(w - i % w) % w];
  }
}

ALWAYS float* row_of(const Context& c, const Field* f, int lane, int y) {
  return f->data + ((size_t)lane * c.g.height + y) * c.g.stride + HALO;
}
static void copy_floats(const Grid& g, float* to, const float* from) {  // a row and its halo
  memcpy(to - REACH, from - REACH, sizeof(float) * (g.width + 2 * REACH));
}
ALWAYS bool copy_row(const Context& c, Field* to, const Field* from, int lane, int y) {
  size_t at = lane * (size_t)c.g.height + y;
  to->live[at] = from->live[at];
  if (from->live[at]) copy_floats(c.g, row_of(c, to, lane, y), row_of(c, from, lane, y));
  return from->live[at];
}
