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
