// Rows of reals, and the rows of planes that they ask for. Comes after planes.hpp.

// Real rows.
ALWAYS const float* real_line(const Context& c, const Field& f, int line, const float* nothing) {
  return f.live[line] ? f.data + (size_t)line * c.g.stride + HALO : nothing;
}
ALWAYS const float* real_line_or_nothing(const Context& c, const Field& f, int base, int y, int rows, const float* nothing) {
  return (u32)y < (u32)rows ? real_line(c, f, base + y, nothing) : nothing;
}
ALWAYS F inside_columns(F value, int x, int dx, int width) {
  if (__builtin_expect(x + dx >= 0 && x + dx + CHUNK <= width, 1)) return value;
  const I number = NUMBERS;
  I at = number + (x + dx);
  return (F)((I)value & (at >= 0) & (at < width));
}
// A word of a lane, and all words of one of its rows together.
ALWAYS Word& lane_word(V* plane, int i, int lane) { return ((Word*)plane)[i * LANES + lane]; }
// Which lanes have anything in each row of some planes.
OUTLINE void mark_rows(Context& c, int place, const Plane* const* planes, int count) {
  const int words = c.g.words, height = c.g.height;
  u32* marks = c.marks + place * height;
  std::fill_n(marks, height, 0);
  const V* data[MARKED + 1];
  int n = 0;
  for (int k = 0; k < count; k++)
    if (!planes[k]->zero) data[n++] = planes[k]->data;
  for (int y = 0; y < height; y++) {
    V some = splat(0);
    for (int k = 0; k < n; k++)
      for (int w = 0; w < words; w++) some |= data[k][y * words + w];
    marks[y] = lanes_of(some);
  }
}
ALWAYS Word row_bits(V* p, int first, int words, int lane) {
  Word some = 0;
  for (int w = 0; w < words; w++) some |= lane_word(p, first + w, lane);
  return some;
}
// Lanes of worlds that are not there hold nothing.
static void no_words(const Context& c, Plane* p) {
  for (int l = c.lanes; l < LANES; l++)
    for (int i = 0; i < c.g.cells(); i++) lane_word(p->data, i, l) = 0;
}
static void no_rows(const Context& c, Field* f) {
  memset(f->live + c.lanes * c.g.height, 0, (LANES - c.lanes) * c.g.height);
}
static void close_plane(const Context& c, Plane* p) {  // nothing beyond the width; and is there anything at all?
  V some = splat(0);
  for (int y = 0, i = 0; y < c.g.height; y++)
    for (int w = 0; w < c.g.words; w++, i++) some |= p->data[i] &= c.valid(w);
  p->zero = !any(some);
}
// Masks of choices, lane by lane: [LANES][height][words][TURNED], so that a lane finds the words of all masks side by side.
ALWAYS void turn(const V* in, V* out, int lanes) {  // TURN vectors; squares of as many words
#ifdef SHUFFLES
  V number;
  for (int l = 0; l < LANES; l++) number[l] = l;
  V rows[TURN];
  _Pragma("GCC unroll 16") for (int i = 0; i < TURN; i++) rows[i] = in[i];
  _Pragma("GCC unroll 4") for (int s = 0; 1 << s < TURN; s++) {  // pairs of rows, then of pairs, and so on
    const V crossed = number ^ (Word)(1 << s), odd = (V)((right(number, s) & 1) != 0);
    const V low = mux(odd, crossed + LANES, number), high = mux(odd, number + LANES, crossed);
    _Pragma("GCC unroll 16") for (int i = 0; i < TURN; i++)
      if (!(i >> s & 1)) {
        const V a = rows[i], b = rows[i | 1 << s];
        rows[i] = two_of(a, low, b);
        rows[i | 1 << s] = two_of(a, high, b);
      }
  }
  _Pragma("GCC unroll 16") for (int i = 0; i < TURN; i++) out[i] = rows[i];
#else
  for (int i = 0; i < TURN; i++)
    for (int l = 0; l < lanes; l++) out[l % TURN][l - l % TURN + i] = in[i][l];
#endif
}
OUTLINE void turn_masks(Context& c, const Plane* const* planes, int count, int place) {
  const int cells = c.g.cells();
  for (int i = 0; i < cells; i++)
    for (int from = 0; from < count; from += TURN) {
      V in[TURN], out[TURN];
      for (int k = 0; k < TURN; k++) in[k] = from + k < count ? planes[from + k]->data[i] : splat(0);
      turn(in, out, c.lanes);
      for (int l = 0; l < c.lanes; l++)
        *(Turned*)(c.turned + ((size_t)l * cells + i) * TURNED + place + from) = ((const Turned*)&out[l % TURN])[l / TURN];
    }
}
ALWAYS const Word* turned_row(const Context& c, int line) { return c.turned + (size_t)line * c.g.words * TURNED; }
ALWAYS u32 turned_bits(Turned a) {  // a bit for each mask that has any
#if VECTOR == 64 && WIDTH == 16
  return _mm256_test_epi16_mask((__m256i)a, (__m256i)a);
#elif VECTOR == 32 && WIDTH == 8
  return (u32)_mm_movemask_epi8((__m128i)(a != 0));
#else
  return lanes_of((V)a);
#endif
}
ALWAYS bool any_turned(const Context& c, const Word* masks, int count) {
  Turned some = {};
  for (int w = 0; w < c.g.words; w++)
    for (int from = 0; from < count; from += TURN) some |= *(const Turned*)(masks + w * TURNED + from);
  return turned_bits(some);
}
// Which of up to 64 masks hold anything in a word.
ALWAYS u64 which_turned(const Word* masks, int count) {
  u64 which = 0;
  for (int from = 0; from < count; from += TURN) which |= (u64)turned_bits(*(const Turned*)(masks + from)) << (from & 63);
  return which;
}
// The chunks of word w, whose values wait in registers.
#define EACH_REGISTER _Pragma("GCC unroll 16") for (int k = 0, x = BITS * w; k < BITS / CHUNK && (WIDTH || x < width); k++, x += CHUNK)
// The worlds of a group: the first lane, and `rows` of them from line `base` on. A row that is not there is `nothing`.
#define EACH_WORLD \
  if (const int rows = c.g.world_height(); true) \
    for (int l = 0; l < c.lanes; l += strips) \
      if (const float* const nothing = c.zeros + HALO; true) \
        if (const int *const lines = c.lines.data() + HALO, base = l * height; true)
// Chunks of the columns in word w, and which of a chunk's columns lie in the grid.
#if WIDTH
#define EACH_CHUNK _Pragma("GCC unroll 4") for (int x = BITS * w; x < BITS * w + BITS; x += CHUNK)
#else
#define EACH_CHUNK for (int x = BITS * w; x < BITS * w + BITS && x < width; x += CHUNK)
#endif
ALWAYS u32 inside_of(int x, int width) { return WIDTH || width - x >= CHUNK ? ALL : (1u << (width - x)) - 1; }
// The flags of a chunk, into one world's word, which is kept little end first.
ALWAYS void put_bits(Word* word, int x, u32 bits) {
#if __BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__
  if constexpr (CHUNK >= 8) {
    memcpy((char*)word + (x & (BITS - 1)) / 8, &bits, CHUNK / 8);
    return;
  }
#endif
  const int by = x & (BITS - 1);
  *word = (*word & ~((Word)ALL << by)) | (Word)bits << by;
}
ALWAYS float* waiting_row(const Context& c, int i) { return c.waiting + (size_t)i * c.g.stride + HALO; }
static bool no_rows_left(const Context& c, const Field* f) { return !memchr(f->live, 1, LANES * c.g.height); }
// The memory of a field that nothing else needs, or other memory.
static Field* overtaken(Context& c, Field* f) {
  if (f != c.calm && f->refs == 1) return f;
  give(c, f);
  return take_field(c);
}
// Copies of a field's first rows, which are read around the edge after they have been written over. They wait from row
// `place` on.
#define KEEP_FIRST(f, count, place) \
  const float* first##f[count]; \
  for (int i = 0; i < (count); i++) { \
    float* const to = waiting_row(c, (place) + i); \
    first##f[i] = v##f.live[base + lines[i]] ? to : nothing; \
    if (first##f[i] == to) copy_floats(c.g, to, row_of(c, v##f, base + lines[i])); \
  }
// Movers exchange what COUNT fields hold with their targets. No cell is both.
template <int COUNT> OUTLINE void swap_fields(Context& c, const Plane* movers, int dy, int dx, Field** const* fields) {
  if (movers->zero) return;
  Field* moved[COUNT];
  int count = 0;
  for (int k = 0; k < COUNT; k++) {
    if ((*fields[k])->still) continue;
    own(c, *fields[k]);
    moved[count++] = *fields[k];
  }
  if (!count) return;
  const int words = c.g.words, width = c.g.width, height = c.g.height, *lines = c.lines.data() + HALO;
  const u32 inner = (u32)std::max(0, width - 2 * REACH);
  for (int y = 0; y < height; y++) {
    V some = splat(0);
    for (int w = 0; w < words; w++) some |= movers->data[y * words + w];
    for (u32 lanes = lanes_of(some); lanes; lanes &= lanes - 1) {
      const int l = __builtin_ctz(lanes);
      if (l >= c.lanes) break;
      const int line = l * height + y, base = (l & -c.g.strips) * height, there = base + lines[line - base + dy];
      float *from[COUNT], *to[COUNT];
      bool edge = false;  // whether the halos change
      int n = 0;
      for (int k = 0; k < count; k++) {
        Field& f = *moved[k];
        if (!f.live[line] && !f.live[there]) continue;
        from[n] = row_of(c, f, line), to[n] = row_of(c, f, there);
        if (!f.live[line]) std::fill_n(from[n], width, 0.f);
        if (!f.live[there]) std::fill_n(to[n], width, 0.f);
        edge |= !f.live[line] || !f.live[there];
        f.live[line] = f.live[there] = 1;
        n++;
      }
      for (int w = 0; w < words; w++)
        for (Word left = lane_word(movers->data, y * words + w, l); left; left &= left - 1) {
          const int x = BITS * w + __builtin_ctzll(left);
          int other = x + c.turn(dx);
          other -= other >= width ? width : 0;
          edge |= (u32)(x - REACH) >= inner || (u32)(other - REACH) >= inner;
          for (int k = 0; k < n; k++) std::swap(from[k][x], to[k][other]);
        }
      for (int k = 0; k < n && edge; k++) {
        finish_row(c.g, from[k]);
        if (there != line) finish_row(c.g, to[k]);
      }
    }
  }
}
