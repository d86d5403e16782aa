// The library that generated code builds on. One group = LANES worlds side by side: lane l of every vector is world l.
// Or, in strips: one world, cut into LANES strips of as many rows, one below the other; lane l is strip l.
// A plane is one bit a cell: 64 columns in a word, a vector holds the same word of all worlds of the group.
// Reals lie by world and row, with a halo of wrapped columns on both sides. Nothing here knows any rule.
#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>
#if defined(__AVX512F__) || defined(__AVX2__)
#include <immintrin.h>
#endif

typedef uint64_t u64;
typedef uint32_t u32;
constexpr int LANES = 8, CHUNK = 16;
typedef u64 V __attribute__((vector_size(64), may_alias));
typedef u32 U __attribute__((vector_size(64), may_alias));
typedef float F __attribute__((vector_size(64), may_alias));
typedef float Fu __attribute__((vector_size(64), may_alias, aligned(4)));
typedef int32_t I __attribute__((vector_size(64), may_alias));
#define ALWAYS static inline __attribute__((always_inline))
#define OUTLINE static __attribute__((noinline))

ALWAYS V splat(u64 x) { return V{x, x, x, x, x, x, x, x}; }
ALWAYS F splatf(float x) { return F{x, x, x, x, x, x, x, x, x, x, x, x, x, x, x, x}; }
ALWAYS U splatu(u32 x) { return U{x, x, x, x, x, x, x, x, x, x, x, x, x, x, x, x}; }
ALWAYS bool any(V a) {
#if defined(__AVX512F__)
  return _mm512_test_epi64_mask((__m512i)a, (__m512i)a) != 0;
#else
  u64 r = 0;
  for (int i = 0; i < LANES; i++) r |= a[i];
  return r != 0;
#endif
}
ALWAYS uint8_t lanes_of(V a) {  // a bit for each world that has any
#if defined(__AVX512F__)
  return _mm512_test_epi64_mask((__m512i)a, (__m512i)a);
#else
  uint8_t r = 0;
  for (int i = 0; i < LANES; i++) r |= (uint8_t)(a[i] != 0) << i;
  return r;
#endif
}
ALWAYS bool any_word(const V* row, int words) {
  V some = row[0];
  for (int w = 1; w < words; w++) some |= row[w];
  return any(some);
}
ALWAYS V mux(V c, V a, V b) { return (c & a) | (~c & b); }

// Sixteen flags as bits 0..15, and back as a choice between two vectors.
ALWAYS u32 bits_of(I m) {
#if defined(__AVX512DQ__)
  return _mm512_movepi32_mask((__m512i)m);
#elif defined(__AVX2__)
  __m256i lo, hi;
  memcpy(&lo, &m, 32);
  memcpy(&hi, (char*)&m + 32, 32);
  return (u32)_mm256_movemask_ps((__m256)lo) | (u32)_mm256_movemask_ps((__m256)hi) << 8;
#else
  u32 r = 0;
  for (int i = 0; i < CHUNK; i++) r |= (u32)(m[i] & 1) << i;
  return r;
#endif
}
// Comparisons of sixteen floats as bits 0..15.
#if defined(__AVX512F__)
#define COMPARE(name, kind, op) ALWAYS u32 name(F a, F b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, kind); }
#else
#define COMPARE(name, kind, op) ALWAYS u32 name(F a, F b) { return bits_of(a op b); }
#endif
COMPARE(bits_eq, _CMP_EQ_OQ, ==)
COMPARE(bits_lt, _CMP_LT_OQ, <)
COMPARE(bits_le, _CMP_LE_OQ, <=)
ALWAYS F blend(u32 bits, F yes, F no) {
#if defined(__AVX512F__)
  return (F)_mm512_mask_blend_ps((__mmask16)bits, (__m512)no, (__m512)yes);
#else
  const I one = {1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768};
  I chosen = ((I)splatu(bits) & one) != 0;
  return (F)(((I)yes & chosen) | ((I)no & ~chosen));
#endif
}
ALWAYS F choose(I m, F yes, F no) { return (F)(((I)yes & m) | ((I)no & ~m)); }
ALWAYS F root(F a) {
#if defined(__AVX512F__)
  return (F)_mm512_sqrt_ps((__m512)a);
#else
  F r;
  for (int i = 0; i < CHUNK; i++) r[i] = __builtin_sqrtf(a[i]);
  return r;
#endif
}
ALWAYS F magnitude(F a) { return (F)((I)a & (I)splatu(0x7fffffff)); }
ALWAYS F divide(F a, F b) { return choose(b == 0.0f, splatf(0), a / b); }
// x / d, rounded as a division is: a product with 1/d, and one correction, are exact where nothing over- or underflows.
ALWAYS F divide_by(F x, float d, float inverse) {
#if defined(__AVX512F__)
  const I size = (I)magnitude(x);
  const I odd = (size < (I)splatf(0x1p-60f)) & (size != 0);
  if (__builtin_expect(bits_of(odd | (size > (I)splatf(0x1p60f))), 0)) return x / splatf(d);
  const __m512 q = _mm512_mul_ps((__m512)x, _mm512_set1_ps(inverse));
  const __m512 rest = _mm512_fnmadd_ps(q, _mm512_set1_ps(d), (__m512)x);
  return (F)_mm512_fmadd_ps(rest, _mm512_set1_ps(inverse), q);
#else
  (void)inverse;
  return x / splatf(d);
#endif
}
ALWAYS F smaller(F a, F b) { return choose(a < b, a, choose(a != a, a, b)); }
ALWAYS F larger(F a, F b) { return choose(a > b, a, choose(a != a, a, b)); }
ALWAYS F settle(F x, float lo, float hi, float snap) {
#if defined(__AVX512F__)
  const __mmask16 some = _mm512_cmp_ps_mask((__m512)magnitude(x), _mm512_set1_ps(snap), _CMP_GE_OQ);  // not for a NaN
  return (F)_mm512_maskz_max_ps(some, _mm512_min_ps((__m512)x, _mm512_set1_ps(hi)), _mm512_set1_ps(lo));
#else
  x = choose(x == x, x, splatf(0));
  x = choose(x < lo, splatf(lo), x);
  x = choose(x > hi, splatf(hi), x);
  return choose(magnitude(x) < snap, splatf(0), x);
#endif
}

struct Plane {
  V* data;
  int refs;
  bool zero;  // known to hold nothing
  int around, beyond;  // rows of the halos that are filled, above and below: of the torus, and with nothing outside
};
struct Field {
  float* data;    // HALO, then [LANES][height][stride]; between rows lie the halos of both
  uint8_t* live;  // [LANES][height]: rows that are not all zero; others are not to be read
  int refs;
  bool still;  // known to have no such row
};

struct Grid {
  int height, width, words, stride;  // height of a lane
  bool strips;
  int cells() const { return height * words; }
  // Strips have halos: behind the rows of a plane lie those above and below on the torus, then the bare ones.
  int above(int y) const { return (height - 1 - y) * words; }  // y < 0
  int below(int y) const { return (AROUND_ROWS + y) * words; }  // y >= height
  int halos() const { return strips ? 2 * (AROUND_ROWS + BEYOND_ROWS) * words : 0; }
  int world_height() const { return strips ? height * LANES : height; }
  bool operator==(const Grid& g) const { return height == g.height && width == g.width && strips == g.strips; }
};

// Everything one thread needs to run groups: buffers, row tables, keys.
struct Context {
  Grid g;
  V valid_last;
  std::vector<int> wrapped;  // [height + 32]: word offset of row y - 16 on the torus, for strips in the halo
  std::vector<int> lines;    // [height of a world + 32]: row y - 16 of a world on the torus
  int turn[2 * HALO + 1];    // dx mod width, for rotations
  std::vector<Plane*> planes, all_planes;
  std::vector<Field*> fields, all_fields;
  Plane *nothing, *everything;
  Field* calm;  // no row of it is live
  V* nothing_row;
  V *change, *late;  // two rows of words; a row for each plane that moves
  u64* active;  // lists of rows, a bit each: [ACTIVE][LANES][active_words]
  float* zeros;
  U k0[STREAMS + 1], k1[STREAMS + 1];
  V step_bits[STEP_PLANES + 1];
  V param_bits[PARAM_PLANES + 1];
  float param_real[PARAM_REALS + 1][LANES];
  Plane* slot[SLOTS + 1];
  Field* real[REALS + 1];
  std::vector<V*> fixed;  // planes of coordinates and insides, made once
  int lanes;
  u64 present;  // the ids that are there, of those that passes ask for; all bits: not known

  V valid(int w) const { return w == g.words - 1 ? valid_last : splat(~0ull); }
  int row(int y) const { return wrapped[y + HALO]; }
  // Rows of a field: the row y of a lane, around the edges of the world; and whether there is such a row.
  int line(int lane, int y) const {
    return g.strips ? lines[lane * g.height + y + HALO] : lane * g.height + lines[y + HALO];
  }
  bool has_line(int lane, int y) const {
    return g.strips ? (u32)(lane * g.height + y) < (u32)(LANES * g.height) : (u32)y < (u32)g.height;
  }
  int active_words() const { return (g.height + 63) / 64; }
};

template <class T> static T* aligned(size_t count) {
  size_t bytes = (count * sizeof(T) + 127) / 64 * 64;
  void* p = aligned_alloc(64, bytes);
  if (!p) abort();
  memset(p, 0, bytes);
  return (T*)p;
}
// Buffers of batches that are gone are used again: fresh memory from the system costs more than a step.
template <class T> struct Spare {
  std::mutex lock;
  size_t size = 0;
  std::vector<T*> waiting;
};
static Spare<Plane> spare_planes;
static Spare<Field> spare_fields;
static void release(Plane* p) { free(p->data); delete p; }
static void release(Field* f) { free(f->data); free(f->live); delete f; }
template <class T> static T* reuse(Spare<T>& spare, size_t size) {
  std::lock_guard<std::mutex> hold(spare.lock);
  if (spare.size != size) {
    for (T* t : spare.waiting) release(t);
    spare.waiting.clear();
    spare.size = size;
  }
  if (spare.waiting.empty()) return nullptr;
  T* t = spare.waiting.back();
  spare.waiting.pop_back();
  return t;
}
template <class T> static void drop(Spare<T>& spare, T* t, size_t size, size_t most) {
  {
    std::lock_guard<std::mutex> hold(spare.lock);
    if (spare.size == size && spare.waiting.size() < most) return spare.waiting.push_back(t);
  }
  release(t);
}
constexpr size_t SPARE_BYTES = 1 << 28;  // at most this much waits, of each kind
static size_t plane_size(const Grid& g) { return sizeof(V) * (g.cells() + g.halos()); }
static size_t field_floats(const Grid& g) { return (size_t)LANES * g.height * g.stride + HALO; }
static size_t field_size(const Grid& g) { return sizeof(float) * field_floats(g); }
static Plane* new_plane(const Grid& g) {  // what it holds is not defined
  Plane* p = reuse(spare_planes, plane_size(g));
  return p ? p : new Plane{aligned<V>(g.cells() + g.halos()), 0, true, 0, 0};
}
static Field* new_field(const Grid& g) {
  Field* f = reuse(spare_fields, field_size(g) + g.height);
  return f ? f : new Field{aligned<float>(field_floats(g) + CHUNK), aligned<uint8_t>(LANES * g.height), 0, true};
}
static void drop(const Grid& g, Plane* p) { drop(spare_planes, p, plane_size(g), SPARE_BYTES / plane_size(g)); }
static void drop(const Grid& g, Field* f) { drop(spare_fields, f, field_size(g) + g.height, SPARE_BYTES / field_size(g)); }

ALWAYS Plane* take(Context& c) {
  Plane* p;
  if (c.planes.empty()) {
    p = new_plane(c.g);
  } else {
    p = c.planes.back();
    c.planes.pop_back();
  }
  p->refs = 1;
  p->around = p->beyond = 0;
  return p;
}
ALWAYS Plane* keep(Plane* p) { p->refs++; return p; }
ALWAYS void give(Context& c, Plane* p) {
  if (--p->refs == 0) c.planes.push_back(p);
}
ALWAYS Field* take_field(Context& c) {
  Field* f;
  if (c.fields.empty()) {
    f = new_field(c.g);
  } else {
    f = c.fields.back();
    c.fields.pop_back();
  }
  f->refs = 1;
  return f;
}
ALWAYS Field* keep(Field* f) { f->refs++; return f; }
ALWAYS void give(Context& c, Field* f) {
  if (--f->refs == 0) c.fields.push_back(f);
}

// Columns: the value at the column dx to the right, wrapping or with nothing beyond the edge.
OUTLINE V columns_far(const Context& c, const V* row, int w, int dx, bool wraps) {
  int n = c.g.words, rest = c.g.width - 64 * (n - 1);
  auto word = [&](int i) -> V {  // words of the endless row: the last is continued by the first
    if (i < 0) {
      if (!wraps) return splat(0);
      return rest == 64 ? row[n - 1] : (row[n - 1] << (64 - rest)) | (row[n - 2] >> rest);
    }
    if (i < n - 1) return row[i];
    if (!wraps) return i == n - 1 ? row[i] : splat(0);
    if (rest == 64) return i == n - 1 ? row[i] : row[0];
    return i == n - 1 ? row[i] | (row[0] << rest) : (row[0] >> (64 - rest)) | (row[1] << rest);
  };
  V r = dx > 0 ? (word(w) >> dx) | (word(w + 1) << (64 - dx)) : (row[w] << -dx) | (word(w - 1) >> (64 + dx));
  return r & c.valid(w);
}
ALWAYS V columns(const Context& c, const V* row, int w, int dx) {
  if (__builtin_expect(c.g.words != 1, 0)) return columns_far(c, row, w, dx, true);
  int by = c.turn[dx + HALO];
  V x = row[0];
  return by ? ((x >> by) | (x << (c.g.width - by))) & c.valid_last : x;
}
ALWAYS V columns_zero(const Context& c, const V* row, int w, int dx) {
  if (__builtin_expect(c.g.words != 1, 0)) return columns_far(c, row, w, dx, false);
  return dx > 0 ? row[0] >> dx : (row[0] << -dx) & c.valid_last;
}
ALWAYS const V* row_or_nothing(const Context& c, const Plane* p, int y) {
  if (__builtin_expect(y >= 0 && y < c.g.height, 1)) return p->data + y * c.g.words;
  if (!c.g.strips) return c.nothing_row;
  return p->data + 2 * AROUND_ROWS * c.g.words + (y < 0 ? c.g.above(y) : c.g.below(y) + (BEYOND_ROWS - AROUND_ROWS) * c.g.words);
}

// Strips. What each lane sees `by` lanes on, around.
ALWAYS V turned(V v, int by) {
#if defined(__AVX512F__)
  return (V)_mm512_permutexvar_epi64((__m512i)(V{0, 1, 2, 3, 4, 5, 6, 7} + splat(by)), (__m512i)v);  // by its low bits
#else
  V r;
  for (int l = 0; l < LANES; l++) r[l] = v[(l + by) & (LANES - 1)];
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
      V kept = splat(~0ull);
      if (!around) for (int l = 0; l < LANES; l++) kept[l] = l + by >= 0 && l + by < LANES ? ~0ull : 0;
      for (int w = 0; w < words; w++) to[w] = turned(from[w], by) & kept;
    }
  (around ? p->around : p->beyond) = rows;
}
// To be called before rows of other strips are read, up to `rows` away.
ALWAYS void edges(const Context& c, Plane* p, int rows) {
  if (c.g.strips && p->around < rows) fill_halo(c, p, rows, true);
}
ALWAYS void bare_edges(const Context& c, Plane* p, int rows) {
  if (c.g.strips && p->beyond < rows) fill_halo(c, p, rows, false);
}

// Draws: bit j of 32 columns is one hash; two make a word.
ALWAYS V draw_plane(const Context& c, int stream, int y, int w, int j) {
  u32 across = (c.g.width + 31) / 32;
  u32 n = ((u32)y * across + 2 * w) * 32 + j;
  const U half = {0, 32, 0, 32, 0, 32, 0, 32, 0, 32, 0, 32, 0, 32, 0, 32};
  U h = (splatu(n) + half) * 0x9E3779B1u + c.k0[stream];
  h ^= h >> 16;
  h *= 0x7FEB352Du;
  h ^= h >> 15;
  h = (h + c.k1[stream]) * 0x846CA68Bu;
  h ^= h >> 16;
  return (V)h;
}
// Which of the wanted cells draw below a constant; stops when all are decided.
OUTLINE V draw_below(const Context& c, int stream, int y, int w, V wanted, int bits, u64 limit) {
  V below = splat(0), open = wanted;
  int last = bits - __builtin_ctzll(limit);
  for (int j = 0; j < last; j++) {
    V p = draw_plane(c, stream, y, w, j);
    if (limit >> (bits - 1 - j) & 1) {
      below |= open & ~p;
      open &= p;
    } else {
      open &= ~p;
    }
    if (!any(open)) break;
  }
  return below;
}
// The same with a limit given plane by plane, most significant (the carry) first.
OUTLINE V draw_below_planes(const Context& c, int stream, int y, int w, V wanted, int bits, const V* limit) {
  V below = wanted & limit[0], open = wanted & ~limit[0];
  for (int j = 0; j < bits && any(open); j++) {
    V p = draw_plane(c, stream, y, w, j), t = limit[1 + j];
    below |= open & t & ~p;
    open &= ~(t ^ p);
  }
  return below;
}
// A draw of one world's cell as float32.
OUTLINE float draw_cell(const Context& c, int stream, int lane, int y, int x, int bits) {
  double value = 0;
  for (int j = 0; j < bits; j++) {
    V p = draw_plane(c, stream, y, x / 64, j);
    value = 2 * value + (double)(p[lane] >> (x % 64) & 1);
  }
  double scale = 1;
  for (int j = 0; j < bits; j++) scale *= 2;
  return (float)((value + 0.5) / scale);
}

// Movements on whole planes.
OUTLINE Plane* shifted(Context& c, Plane* p, int dy, int dx) {
  if (p->zero) return keep(c.nothing);
  edges(c, p, abs(dy));
  Plane* r = take(c);
  V some = splat(0);
  for (int y = 0; y < c.g.height; y++) {
    const V* from = p->data + c.row(y + dy);
    for (int w = 0; w < c.g.words; w++) {
      V x = dx ? columns(c, from, w, dx) : from[w];
      some |= x;
      r->data[y * c.g.words + w] = x;
    }
  }
  r->zero = !any(some);
  return r;
}
// Movers (and `targets`, the same seen from the other side) exchange what they hold.
OUTLINE Plane* swap_plane(Context& c, Plane* content, const Plane* movers, const Plane* targets, Plane* rest, int dy, int dx) {
  if (content->zero && rest->zero) return keep(rest);
  edges(c, content, abs(dy));
  Plane* r = take(c);
  V some = splat(0);
  for (int y = 0; y < c.g.height; y++) {
    const V *down = content->data + c.row(y + dy), *up = content->data + c.row(y - dy);
    for (int w = 0; w < c.g.words; w++) {
      int i = y * c.g.words + w;
      V there = dx ? columns(c, down, w, dx) : down[w], back = dx ? columns(c, up, w, -dx) : up[w];
      V x = mux(movers->data[i], there, mux(targets->data[i], back, rest->data[i]));
      some |= x;
      r->data[i] = x;
    }
  }
  r->zero = !any(some);
  return r;
}
OUTLINE Plane* arrive_plane(Context& c, Plane* content, const Plane* targets, Plane* rest, int dy, int dx) {
  if (targets->zero || (content->zero && rest->zero)) return keep(rest);
  edges(c, content, abs(dy));
  Plane* r = take(c);
  V some = splat(0);
  for (int y = 0; y < c.g.height; y++) {
    const V* up = content->data + c.row(y - dy);
    for (int w = 0; w < c.g.words; w++) {
      int i = y * c.g.words + w;
      V back = dx ? columns(c, up, w, -dx) : up[w];
      V x = mux(targets->data[i], back, rest->data[i]);
      some |= x;
      r->data[i] = x;
    }
  }
  r->zero = !any(some);
  return r;
}
// A plane of this owner alone, to be written over.
static void own(Context& c, Plane*& p) {
  if (p != c.nothing && p != c.everything && p->refs == 1) {
    p->around = p->beyond = 0;
    return;
  }
  Plane* copy = take(c);
  if (p->zero) memset(copy->data, 0, sizeof(V) * c.g.cells());
  else memcpy(copy->data, p->data, sizeof(V) * c.g.cells());
  copy->zero = p->zero;
  give(c, p);
  p = copy;
}
// Planes that move together, in place.
enum Leaves { NOTHING, EVERYTHING, SAME };  // what movers leave behind
// A row that exchanges with one of other strips, `by` of them on.
OUTLINE void swap_strips(Context& c, const V* m, V* const* data, int n, int here_row, int there_row, int by, int dx) {
  const int words = c.g.words;
  V* seen = c.change + words;
  for (int k = 0; k < n; k++) {
    V *here = data[k] + here_row * words, *there = data[k] + there_row * words;
    for (int w = 0; w < words; w++) seen[w] = turned(there[w], by);
    for (int w = 0; w < words; w++) c.change[w] = (here[w] ^ (dx ? columns(c, seen, w, dx) : seen[w])) & m[w];
    for (int w = 0; w < words; w++) here[w] ^= c.change[w];
    for (int w = 0; w < words; w++) there[w] ^= turned(dx ? columns(c, c.change, w, -dx) : c.change[w], -by);
  }
}
// Movers exchange what they hold with their targets. No cell is both.
OUTLINE void swap_planes(Context& c, const Plane* movers, int dy, int dx, Plane** const* planes, int count) {
  if (movers->zero) return;
  V* data[MOVING + 1];
  int n = 0;
  for (int k = 0; k < count; k++) {
    Plane*& p = *planes[k];
    if (p->zero) continue;
    own(c, p);
    data[n++] = p->data;
  }
  const int words = c.g.words, by = c.turn[dx + HALO], back = c.g.width - by;
  for (int y = 0; y < c.g.height; y++) {
    const V* m = movers->data + y * words;
    if (c.g.strips && (u32)(y + dy) >= (u32)c.g.height) {
      const int by = strips_on(c, y + dy);
      if (any_word(m, words)) swap_strips(c, m, data, n, y, y + dy - by * c.g.height, by, dx);
      continue;
    }
    if (words > 1 && dx) {
      if (!any_word(m, words)) continue;
      for (int k = 0; k < n; k++) {
        V *here = data[k] + y * words, *there = data[k] + c.row(y + dy);
        for (int w = 0; w < words; w++) c.change[w] = (here[w] ^ columns(c, there, w, dx)) & m[w];
        for (int w = 0; w < words; w++) here[w] ^= c.change[w];
        for (int w = 0; w < words; w++) there[w] ^= columns(c, c.change, w, -dx);
      }
      continue;
    }
    for (int w = 0; w < words; w++) {
      if (!any(m[w])) continue;
      const int here = y * words + w, there = c.row(y + dy) + w;
      for (int k = 0; k < n; k++) {
        const V a = data[k][here], b = data[k][there];
        const V d = (a ^ (by ? (b >> by) | (b << back) : b)) & m[w];
        data[k][here] = a ^ d;
        data[k][there] ^= by ? ((d << by) | (d >> back)) & c.valid_last : d;  // read again: it may be the same row
      }
    }
  }
}
// Movers go to their targets, at most a row away. A cell that is both holds what arrives: each row is read before
// anything arrives there, and what goes around the edge arrives last.
template <Leaves LEAVES, bool AROUND>
ALWAYS void arrive_row(const Context& c, V* const* data, int count, int here, int there, const V* m, const V* targets, int dx) {
  const int words = c.g.words, by = c.turn[-dx + HALO], back = c.g.width - by;
  if (__builtin_expect(words == 1, 1)) {
    const V gone = m[0], keeps = ~targets[0], valid = c.valid_last;
    for (int k = 0; k < count; k++) {
      const V a = data[k][here], moving = a & gone;
      const V arriving = by ? ((moving >> by) | (moving << back)) & valid : moving;
      if (LEAVES == NOTHING) data[k][here] = a & ~gone;
      if (LEAVES == EVERYTHING) data[k][here] = a | gone;
      if (AROUND) c.late[k] = arriving;
      else data[k][there] = (data[k][there] & keeps) | arriving;
    }
    return;
  }
  V* moving = c.change + words;
  for (int k = 0; k < count; k++) {
    for (int w = 0; w < words; w++) moving[w] = data[k][here + w] & m[w];
    if (LEAVES == NOTHING) for (int w = 0; w < words; w++) data[k][here + w] &= ~m[w];
    if (LEAVES == EVERYTHING) for (int w = 0; w < words; w++) data[k][here + w] |= m[w];
    for (int w = 0; w < words; w++) {
      const V arriving = dx ? columns(c, moving, w, -dx) : moving[w];
      if (AROUND) c.late[k * words + w] = arriving;
      else data[k][there + w] = (data[k][there + w] & ~targets[w]) | arriving;
    }
  }
}
template <Leaves LEAVES> OUTLINE void arrive_planes(Context& c, const Plane* movers, int dy, int dx, Plane** const* planes, int count) {
  if (movers->zero) return;
  V* data[MOVING + 1];
  int n = 0;
  for (int k = 0; k < count; k++) {
    Plane*& p = *planes[k];
    if (p->zero && LEAVES != EVERYTHING) continue;
    own(c, p);
    p->zero = false;
    data[n++] = p->data;
  }
  const int words = c.g.words, height = c.g.height;
  V* targets = c.change;
  for (int i = 0, y = dy > 0 ? height - 1 : 0; i < height; i++, y += dy > 0 ? -1 : 1) {
    const V* m = movers->data + y * words;
    if (!any_word(m, words)) continue;
    for (int w = 0; w < words; w++) targets[w] = dx ? columns(c, m, w, -dx) : m[w];
    if (y + dy < 0 || y + dy >= height) arrive_row<LEAVES, true>(c, data, n, y * words, 0, m, targets, dx);
    else arrive_row<LEAVES, false>(c, data, n, y * words, (y + dy) * words, m, targets, dx);
  }
  const int edge = dy > 0 ? height - 1 : 0;
  const V* m = movers->data + edge * words;
  if (!dy || !any_word(m, words)) return;
  const int lanes_back = c.g.strips ? -dy : 0;
  for (int w = 0; w < words; w++) targets[w] = turned(dx ? columns(c, m, w, -dx) : m[w], lanes_back);
  for (int k = 0; k < n; k++) {
    V* there = data[k] + (dy > 0 ? 0 : height - 1) * words;
    for (int w = 0; w < words; w++) there[w] = (there[w] & ~targets[w]) | turned(c.late[k * words + w], lanes_back);
  }
}
OUTLINE Plane* cleared(Context& c, Plane* old, const Plane* where) {  // old and not where
  if (old->zero || where->zero) return keep(old);
  Plane* r = take(c);
  V some = splat(0);
  for (int i = 0, n = c.g.cells(); i < n; i++) some |= r->data[i] = old->data[i] & ~where->data[i];
  r->zero = !any(some);
  return r;
}
OUTLINE Plane* joined(Context& c, Plane* old, Plane* where) {  // old or where
  if (where->zero) return keep(old);
  if (old->zero) return keep(where);
  Plane* r = take(c);
  for (int i = 0, n = c.g.cells(); i < n; i++) r->data[i] = old->data[i] | where->data[i];
  r->zero = false;
  return r;
}

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
  const I lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
  I at = lane + (x + dx);
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
#define EACH_ACTIVE(list) /* of the sixteen rows that begin at `from` */ \
  for (u32 rest = c.active[((size_t)(list) * LANES + l) * c.active_words() + from / 64] >> (from & 63) & 0xffff; rest; rest &= rest - 1) \
    if (const int y = from + __builtin_ctz(rest); true)
// Sixteen flags of one world's word, which is kept little end first.
ALWAYS void put_bits(u64* word, int x, u32 bits) {
#if __BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__
  const uint16_t half = (uint16_t)bits;
  memcpy((char*)word + (x & 63) / 8, &half, 2);
#else
  const int by = x & 63;
  *word = (*word & ~(0xffffull << by)) | (u64)bits << by;
#endif
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

// Seconds spent in each pass, measured only in libraries that are built to be profiled.
#if defined(PROFILE)
#include <ctime>
static double pass_seconds[PASSES + 1];
static double thread_seconds() {
  timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
#define START double tick = thread_seconds()
#define TICK(i) do { double now = thread_seconds(); pass_seconds[i] += now - tick; tick = now; } while (0)
#else
#define START
#define TICK(i)
#endif

// Keys
static inline u32 mix(u32 x) {
  x ^= x >> 16;
  x *= 0x7FEB352Du;
  x ^= x >> 15;
  x *= 0x846CA68Bu;
  return x ^ (x >> 16);
}
static u32 key(u64 seed, u64 index, u64 step, u32 stream, u32 start) {
  u32 k = start;
  for (u32 part : {(u32)seed, (u32)(seed >> 32), (u32)index, (u32)step, stream}) k = mix(k + part);
  return k;
}
