// The library that generated kernels build on. One block holds GROUP worlds and runs many steps on them.
// A plane is one bit a cell: 32 columns in a word. In phases over words a thread has a word, in phases over cells a
// warp has a word and a lane a cell. Between phases that see each other's words stands SYNC or ANY, a barrier that
// also tells whether anything holds anywhere in the block. Nothing here knows any rule, and nothing is included.
typedef unsigned int u32;
typedef unsigned long long u64;

constexpr int WORDS = HEIGHT * ROW_WORDS, BLOCK_WORDS = GROUP * WORDS, CELLS = GROUP * HEIGHT * WIDTH;
constexpr int ROUNDS = (BLOCK_WORDS + THREADS - 1) / THREADS;
constexpr u32 LAST_WORD = WIDTH % 32 ? (1u << WIDTH % 32) - 1 : ~0u;

#if !defined(EMULATED)
#define DEVICE static __device__ __forceinline__
#define OUTLINE static __device__ __noinline__
#define KERNEL extern "C" __global__ void __launch_bounds__(THREADS, BLOCKS)
#define TABLE static __device__ const
#define THREAD ((int)threadIdx.x)
#define BLOCK ((int)blockIdx.x)
#define SYNC() __syncthreads()
#define ANY(x) (__syncthreads_or(x) != 0)
#define LANES if (const int lane = (int)threadIdx.x & 31; true)
#define ONCE if (((int)threadIdx.x & 31) == 0)
#define BALLOT(word, flag) word = __ballot_sync(0xffffffffu, flag)
#define ROOT(x) __fsqrt_rn(x)
#define MAGNITUDE(x) fabsf(x)
extern __shared__ u32 chip[];

constexpr int WARPS = THREADS / 32;
// Which of this warp's 32 words need work: each lane asks for one of them.
template <class Need> DEVICE u32 busy_words(int base, Need need) {
  const int i = base + ((int)threadIdx.x & 31) * WARPS + (int)threadIdx.x / 32;
  const u32 todo = __ballot_sync(0xffffffffu, i < BLOCK_WORDS && need(i));
  __syncwarp();
  return todo;
}
DEVICE int word_of(int base, u32 todo) { return base + (__ffs((int)todo) - 1) * WARPS + (int)threadIdx.x / 32; }
DEVICE u32 funnel(u32 low, u32 high, int by) { return __funnelshift_r(low, high, by); }
#endif

#define FOR_WORDS(k, i) for (int k = 0, i = THREAD; k < ROUNDS; k++, i += THREADS) if (i < BLOCK_WORDS)
#define FOR_BUSY_WORDS(i, need)                                                \
  for (int base = 0; base < BLOCK_WORDS; base += THREADS)                      \
    for (u32 todo = busy_words(base, need); todo; todo &= todo - 1)            \
      if (const int i = word_of(base, todo); true)
#define PLACE(i)                                                                           \
  const int l = GROUP == 1 ? 0 : i / WORDS, at = GROUP == 1 ? i : i % WORDS;               \
  const int y = at / ROW_WORDS, w = at % ROW_WORDS;                                        \
  const u32 valid = valid_columns(w);                                                      \
  (void)l, (void)y, (void)w, (void)valid
#define CELL                                                                               \
  const bool inside = 32 * w + lane < WIDTH;                                               \
  const int x = inside ? 32 * w + lane : WIDTH - 1, cell = (l * HEIGHT + y) * WIDTH + x;   \
  (void)cell
#define BIT(word) ((word) >> lane & 1)

// Numbers that are the same in a whole world lie first in shared memory, then planes, then fields and where they live.
constexpr int AT_BASE = 0, AT_KEYS = 2 * GROUP, AT_STEP = AT_KEYS + 2 * STREAMS * GROUP;
constexpr int AT_FLAGS = AT_STEP + STEP_PLANES * GROUP, AT_NUMBERS = AT_FLAGS + PARAM_PLANES * GROUP;
constexpr int AT_PLANES = AT_NUMBERS + PARAM_REALS * GROUP;
constexpr int PLANE_WORDS = PLANES * BLOCK_WORDS, FIELD_WORDS = FIELDS * (CELLS + BLOCK_WORDS);
constexpr int AT_FIELDS = AT_PLANES + (PLANES_ON_CHIP ? PLANE_WORDS : 0);
constexpr int CHIP_WORDS = AT_FIELDS + (FIELDS_ON_CHIP ? FIELD_WORDS : 0);
constexpr int SCRATCH_WORDS = (PLANES_ON_CHIP ? 0 : PLANE_WORDS) + (FIELDS_ON_CHIP ? 0 : FIELD_WORDS);
struct Block {
  u32 *planes, *fields;
};
#if PLANES_ON_CHIP
#define P(n) (chip + AT_PLANES + (n) * BLOCK_WORDS)
#else
#define P(n) (c.planes + (size_t)(n) * BLOCK_WORDS)
#endif
#if FIELDS_ON_CHIP
#define F(n) ((float*)(chip + AT_FIELDS) + (n) * CELLS)
#define N(n) (chip + AT_FIELDS + FIELDS * CELLS + (n) * BLOCK_WORDS)
#else
#define F(n) ((float*)c.fields + (size_t)(n) * CELLS)
#define N(n) (c.fields + (size_t)FIELDS * CELLS + (size_t)(n) * BLOCK_WORDS)
#endif
#define STEP_FLAG(n) chip[AT_STEP + (n) * GROUP + l]
#define PARAM_FLAG(n) chip[AT_FLAGS + (n) * GROUP + l]
#define PARAM_REAL(n) (((const float*)chip)[AT_NUMBERS + (n) * GROUP + l])

DEVICE u32 valid_columns(int w) { return WIDTH % 32 == 0 || w < ROW_WORDS - 1 ? ~0u : LAST_WORD; }
DEVICE u32 mux(u32 c, u32 a, u32 b) { return (c & a) | (~c & b); }
DEVICE u32 spread(bool flag) { return flag ? ~0u : 0; }

// Neighbours on the torus.
DEVICE int around(int at, int by, int size) {
  if (by > size || by < -size) return ((at + by) % size + size) % size;
  at += by;
  return at < 0 ? at + size : at >= size ? at - size : at;
}
DEVICE int row(int l, int y, int dy) { return (l * HEIGHT + around(y, dy, HEIGHT)) * ROW_WORDS; }
DEVICE u32 columns(const u32* row, int w, int dx) {  // each column's value at the column dx to the right
  const int by = (dx % WIDTH + WIDTH) % WIDTH;
  if (WIDTH % 32 == 0) {
    int first = w + by / 32, second = first + 1;
    first = first >= ROW_WORDS ? first - ROW_WORDS : first;
    second = second >= ROW_WORDS ? second - ROW_WORDS : second;
    return by % 32 ? funnel(row[first], row[second], by % 32) : row[first];
  }
  if (ROW_WORDS == 1) return by ? ((row[0] >> by) | (row[0] << (WIDTH - by))) & LAST_WORD : row[0];
  int start = 32 * w + by;
  start = start >= WIDTH ? start - WIDTH : start;
  int word = start / 32, have = (word == ROW_WORDS - 1 ? WIDTH % 32 : 32) - start % 32;
  u32 result = row[word] >> start % 32;
  while (have < 32) {
    word = word == ROW_WORDS - 1 ? 0 : word + 1;
    result |= row[word] << have;
    have += word == ROW_WORDS - 1 ? WIDTH % 32 : 32;
  }
  return result & valid_columns(w);
}
DEVICE u32 columns_below(int count, int w) {  // columns 0 .. count - 1 of word w
  count -= 32 * w;
  return count <= 0 ? 0 : count >= 32 ? ~0u : (1u << count) - 1;
}
DEVICE u32 inside_word(int y, int w, int dy, int dx) {  // cells whose neighbor lies inside the grid
  if (y + dy < 0 || y + dy >= HEIGHT) return 0;
  return columns_below(dx > 0 ? WIDTH - dx : WIDTH, w) & (dx < 0 ? ~columns_below(-dx, w) : ~0u);
}
// Where a field is other than zero in row y + dy, in the words that hold columns up to `reach` from those of word w.
DEVICE u32 near(const u32* lives, int l, int y, int w, int dy, int reach) {
  const u32* words = lives + row(l, y, dy);
  const int far = (reach + 31) / 32 + (reach && WIDTH % 32 ? 1 : 0);
  u32 some = 0;
  if (2 * far + 1 >= ROW_WORDS)
    for (int i = 0; i < ROW_WORDS; i++) some |= words[i];
  else
    for (int i = -far; i <= far; i++) some |= words[around(w, i, ROW_WORDS)];
  return some;
}

// Draws: bit j of 32 columns is one hash.
DEVICE u32 draw_plane(int stream, int l, int y, int w, int j) {
  u32 h = ((u32)(y * ROW_WORDS + w) * 32u + (u32)j) * 0x9E3779B1u + chip[AT_KEYS + 2 * stream * GROUP + l];
  h ^= h >> 16;
  h *= 0x7FEB352Du;
  h ^= h >> 15;
  h = (h + chip[AT_KEYS + (2 * stream + 1) * GROUP + l]) * 0x846CA68Bu;
  return h ^ h >> 16;
}
// Which of the wanted cells draw below a constant, `bits` in a row from the highest; stops when all are decided.
DEVICE u32 draw_below(int stream, int l, int y, int w, u32 wanted, int bits, u64 limit) {
  u32 below = 0, open = wanted;
  for (int j = bits - 1; j >= 0 && open && limit << (63 - j); j--) {
    const u32 p = draw_plane(stream, l, y, w, bits - 1 - j);
    const u32 bound = spread(limit >> j & 1);
    below |= open & bound & ~p;
    open &= ~(bound ^ p);
  }
  return below;
}
// The same with a limit given plane by plane, most significant (the carry) first.
DEVICE u32 draw_below_planes(int stream, int l, int y, int w, u32 wanted, int bits, const u32* limit) {
  u32 below = wanted & limit[0], open = wanted & ~limit[0];
  for (int j = 0; j < bits && open; j++) {
    const u32 p = draw_plane(stream, l, y, w, j), bound = limit[1 + j];
    below |= open & bound & ~p;
    open &= ~(bound ^ p);
  }
  return below;
}
// A cell's draw as float32: (k + 1/2) / 2^bits, rounded once.
OUTLINE float draw_cell(int stream, int l, int y, int x, int bits) {
  u64 k = 0;
  for (int j = 0; j < bits; j++) k = 2 * k + (draw_plane(stream, l, y, x / 32, j) >> x % 32 & 1);
  float value = (float)(2 * k + 1);
  for (int j = 0; j <= bits; j++) value *= 0.5f;
  return value;
}

// Reals: every operation rounded by itself, in the order of the rules.
DEVICE float divide(float a, float b) { return b == 0 ? 0.0f : a / b; }
DEVICE float smaller(float a, float b) { return a < b ? a : a != a ? a : b; }
DEVICE float larger(float a, float b) { return a > b ? a : a != a ? a : b; }
DEVICE float clamped(float x, float lo, float hi) {
  x = x == x ? x : 0.0f;
  x = x < lo ? lo : x;
  x = x > hi ? hi : x;
  return MAGNITUDE(x) < SNAP ? 0.0f : x;
}

// Keys
DEVICE u32 mix(u32 x) {
  x ^= x >> 16;
  x *= 0x7FEB352Du;
  x ^= x >> 15;
  x *= 0x846CA68Bu;
  return x ^ x >> 16;
}
