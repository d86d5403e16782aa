// Work on planes: columns and rows of neighbors, draws. Comes after runtime.hpp.

// Columns: the value at the column dx to the right, wrapping or with nothing beyond the edge.
OUTLINE V columns_far(const Context& c, const V* row, int w, int dx) {  // farther than the last word of a row is wide
  const int n = c.g.words, rest = c.rest;
  auto word = [&](int i) -> V {  // words of the endless row: the last is continued by the first
    if (i < 0) return left(row[n - 1], BITS - rest) | right(row[n - 2], rest);
    if (i < n - 1) return row[i];
    return i == n - 1 ? row[i] | left(row[0], rest) : right(row[0], BITS - rest) | left(row[1], rest);
  };
  V r = dx > 0 ? right(word(w), dx) | left(word(w + 1), BITS - dx) : left(row[w], -dx) | right(word(w - 1), BITS + dx);
  return r & c.valid(w);
}
ALWAYS int next_word(const Context& c, int w, int dx) {  // on the side that dx points to, around
  return dx > 0 ? (w + 1 == c.g.words ? 0 : w + 1) : (w == 0 ? c.g.words - 1 : w - 1);
}
ALWAYS int columns_in(const Context& c, int w) { return w == c.g.words - 1 ? c.rest : BITS; }
ALWAYS V around(const Context& c, V x, int by) {  // a row of one word, `by` columns to the left on the torus
  if (WIDTH) return rotated(x, by);
  return (right(x, by) | left(x, c.g.width - by)) & c.valid(0);
}
ALWAYS V columns(const Context& c, const V* row, int w, int dx) {
  if (__builtin_expect(c.g.words != 1, 0)) {
    if (abs(dx) > c.rest) return columns_far(c, row, w, dx);
    const int next = next_word(c, w, dx);
    if (dx > 0) return (right(row[w], dx) | left(row[next], columns_in(c, w) - dx)) & c.valid(w);
    return (left(row[w], -dx) | right(row[next], columns_in(c, next) + dx)) & c.valid(w);
  }
  const int by = c.turn(dx);
  return by ? around(c, row[0], by) : row[0];
}
ALWAYS V columns_zero(const Context& c, const V* row, int w, int dx) {
  V x = dx > 0 ? right(row[w], dx) : left(row[w], -dx);
  if (dx > 0 && w + 1 < c.g.words) x |= left(row[w + 1], BITS - dx);
  if (dx < 0 && w > 0) x |= right(row[w - 1], BITS + dx);
  return x & c.valid(w);
}
ALWAYS const V* row_or_nothing(const Context& c, const Plane* p, int y) {
  if (__builtin_expect(y >= 0 && y < c.g.height, 1)) return p->data + y * c.g.words;
  if (c.g.strips == 1) return c.nothing_row;
  return p->data + 2 * AROUND_ROWS * c.g.words + (y < 0 ? c.g.above(y) : c.g.below(y) + (BEYOND_ROWS - AROUND_ROWS) * c.g.words);
}

// Strips. The lane that each lane sees `by` lanes on, around those of its world.
ALWAYS V lanes_on(const Context& c, int by) {
  V number;
  for (int l = 0; l < LANES; l++) number[l] = l;
  return mux(splat(c.g.strips - 1), number + splat(by), number);
}
ALWAYS V turned(V v, V lanes) {  // what each lane sees there
#ifdef SHUFFLES
  return two_of(v, lanes, v);
#else
  V r;
  for (int l = 0; l < LANES; l++) r[l] = v[lanes[l]];
  return r;
#endif
}
ALWAYS int strips_on(const Context& c, int y) {  // how many strips below its own the row y of a strip lies
  return y >= 0 ? y / c.g.height : -((c.g.height - 1 - y) / c.g.height);
}
OUTLINE void fill_halo(const Context& c, Plane* p, int rows, bool around) {
  const int words = c.g.words, height = c.g.height;
  for (int i = 1; i <= rows; i++)
    for (int y : {-i, height - 1 + i}) {
      const int by = strips_on(c, y);
      const V* from = p->data + (y - by * height) * words;
      V* to = around ? p->data + c.row(y) : (V*)row_or_nothing(c, p, y);
      const V lanes = lanes_on(c, by);
      V kept = splat(FULL);
      if (!around) for (int l = 0; l < LANES; l++) kept[l] = (u32)((l & (c.g.strips - 1)) + by) < (u32)c.g.strips ? FULL : 0;
      for (int w = 0; w < words; w++) to[w] = turned(from[w], lanes) & kept;
    }
  (around ? p->around : p->beyond) = rows;
}
// To be called before rows of other strips are read, up to `rows` away.
ALWAYS void edges(const Context& c, Plane* p, int rows) {
  if (c.g.strips > 1 && p->around < rows) fill_halo(c, p, rows, true);
}
ALWAYS void bare_edges(const Context& c, Plane* p, int rows) {
  if (c.g.strips > 1 && p->beyond < rows) fill_halo(c, p, rows, false);
}

// Keys
template <class T> ALWAYS T mix(T x) {
  x ^= x >> 16;
  x *= 0x7FEB352Du;
  x ^= x >> 15;
  x *= 0x846CA68Bu;
  return x ^ (x >> 16);
}
static u32 world_key(u64 seed, u64 index, int half) {  // of all steps and streams
  constexpr u32 INITIAL[] = {0x243F6A88u, 0x85A308D3u};
  return mix(mix(mix(INITIAL[half] + (u32)seed) + (u32)(seed >> 32)) + (u32)index);
}

// Draws: bit j of 32 columns is one hash; a word has one or two, or the low bits of one. A plane's hashes start a constant after those of the plane before.
constexpr u32 APART = 0x9E3779B1u;
struct Start { U part[PARTS]; };
ALWAYS Start draw_start(const Context& c, int stream, int y, int w) {
  const u32 across = (c.g.width + 31) / 32, n = ((u32)y * across + HASHES * w) * 32;
  const U number = NUMBERS;
  Start start;
  for (int i = 0; i < PARTS; i++) start.part[i] = splatu(n * APART) + (number & (HASHES - 1)) * (32 * APART) + c.k0[stream][i];
  return start;
}
ALWAYS V draw_plane(const Context& c, int stream, const Start& start, int j) {
  U bits = {};
  for (int i = 0; i < PARTS; i++) {
    U h = start.part[i] + splatu((u32)j * APART);
    h ^= h >> 16;
    h *= 0x7FEB352Du;
    h ^= h >> 15;
    h = (h + c.k1[stream][i]) * 0x846CA68Bu;
    h ^= h >> 16;
    bits |= PARTS == 1 ? h : (h & (u32)FULL) << BITS * i % 32;
  }
  return (V)bits;
}
// Several planes at once: the multiplications of one wait for each other, and after so many hardly a cell is open, so that the
// processor foresees whether there are more.
constexpr int AHEAD = VECTOR == 64 ? 8 : 4;
#define EACH_AHEAD _Pragma("GCC unroll 8") for (int i = 0; i < AHEAD; i++)
struct Drawn { V plane[AHEAD]; };
ALWAYS Drawn draw_planes(const Context& c, int stream, const Start& start, int first) {
  Drawn d;
  EACH_AHEAD d.plane[i] = draw_plane(c, stream, start, first + i);
  return d;
}
// Of the cells still open, those whose draw has a 0 where the limit has a 1 are below it; equal bits leave a cell open.
ALWAYS void compare_bit(V& below, V& open, V drawn, V limit) {
  below |= open & limit & ~drawn;
  open &= ~(limit ^ drawn);
}
ALWAYS V limit_bit(u64 limit, int bits, int j) { return splat((Word)0 - (Word)(limit >> (bits - 1 - j) & 1)); }
// Which of the wanted cells draw below a constant; stops when all are decided.
OUTLINE V draw_below(const Context& c, int stream, int y, int w, V wanted, int bits, u64 limit) {
  const Start start = draw_start(c, stream, y, w);
  V below = splat(0), open = wanted;
  int j = 0;
  const int last = bits - __builtin_ctzll(limit);
  for (; j + AHEAD <= last && any(open); j += AHEAD) {
    const Drawn d = draw_planes(c, stream, start, j);
    EACH_AHEAD compare_bit(below, open, d.plane[i], limit_bit(limit, bits, j + i));
  }
  for (; j < last && any(open); j++) compare_bit(below, open, draw_plane(c, stream, start, j), limit_bit(limit, bits, j));
  return below;
}
// The same with a limit given bit by bit, as flags or planes, most significant (the carry) first.
template <class T> OUTLINE V draw_below_planes(const Context& c, int stream, int y, int w, V wanted, int bits, const T* limit) {
  const Start start = draw_start(c, stream, y, w);
  V below = wanted & words_of(limit[0]), open = wanted & ~words_of(limit[0]);
  int j = 0;
  for (; j + AHEAD <= bits && any(open); j += AHEAD) {
    const Drawn d = draw_planes(c, stream, start, j);
    EACH_AHEAD compare_bit(below, open, d.plane[i], words_of(limit[1 + j + i]));
  }
  for (; j < bits && any(open); j++) compare_bit(below, open, draw_plane(c, stream, start, j), words_of(limit[1 + j]));
  return below;
}
// The highest bit of a draw. Many masks ask for it, in several passes: it is made once a step.
static V* coin_plane(Context& c, int coin, int stream) {
  V* plane = c.coins[coin];
  if (!c.tossed[coin])
    for (int y = 0; y < c.g.height; y++)
      for (int w = 0; w < c.g.words; w++) plane[y * c.g.words + w] = draw_plane(c, stream, draw_start(c, stream, y, w), 0);
  c.tossed[coin] = true;
  return plane;
}
// A draw of one world's cell as float32.
OUTLINE float draw_cell(const Context& c, int stream, int lane, int y, int x, int bits) {
  double value = 0;
  const Start start = draw_start(c, stream, y, x / BITS);
  for (int j = 0; j < bits; j++) {
    V p = draw_plane(c, stream, start, j);
    value = 2 * value + (double)(p[lane] >> (x % BITS) & 1);
  }
  double scale = 1;
  for (int j = 0; j < bits; j++) scale *= 2;
  return (float)((value + 0.5) / scale);
}
