// Random numbers: keys of worlds, steps and streams, and draws of cells. Comes after planes.hpp.

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
// Several planes at once: the multiplications of one plane depend on each other. After this number of planes few cells are
// open, so that the processor predicts the branch.
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
template <class T> ALWAYS V draw_below_bits(const Context& c, int stream, int y, int w, V wanted, int bits, const T* limit) {
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
OUTLINE V draw_below_flags(const Context& c, int stream, int y, int w, V wanted, int bits, const Flags* limit) {
  return draw_below_bits(c, stream, y, w, wanted, bits, limit);
}
OUTLINE V draw_below_planes(const Context& c, int stream, int y, int w, V wanted, int bits, const V* limit) {
  return draw_below_bits(c, stream, y, w, wanted, bits, limit);
}
// The highest bit of a draw. Many masks ask for it, in several passes: it is made once a step.
OUTLINE V* coin_plane(Context& c, int coin, int stream) {
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
