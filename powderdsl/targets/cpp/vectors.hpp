// The library that generated code builds on. One group = LANES worlds side by side: lane l of every vector is world l.
// Or, in strips: fewer worlds, each cut into strips of as many rows, one below the other, in lanes side by side.
// A plane is one bit a cell: 64 columns in a word, or as many as worlds have if those are 8, 16 or 32; a vector holds the same
// word of all worlds of the group.
// Reals lie by world and row, with a halo of wrapped columns on both sides. Nothing here knows any rule.
#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <vector>
#if defined(__wasm__)
#define CLOCK_THREAD_CPUTIME_ID CLOCK_MONOTONIC
#endif
#if defined(__SSE2__)
#include <immintrin.h>
#endif

typedef uint64_t u64;
typedef uint32_t u32;
// A vector is a register of the processor: compilers keep wider ones in memory, which takes six times as long. Where words
// have 8 bits, a narrower one, so that it has no more floats than a word has columns.
#if defined(__AVX512BW__) && WIDTH != 8
#define VECTOR 64
#define NUMBERS {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}
#elif defined(__AVX2__)
#define VECTOR 32
#define NUMBERS {0, 1, 2, 3, 4, 5, 6, 7}
#else
#define VECTOR 16
#define NUMBERS {0, 1, 2, 3}
#endif
// WIDTH is the number of columns if the library is for grids of that width alone, else 0. Most work is loops over the words
// of a row and over columns: where their number is known, they cost a quarter less and compile faster.
#if WIDTH == 8
typedef uint8_t Word;
#elif WIDTH == 16
typedef uint16_t Word;
#elif WIDTH == 32
typedef u32 Word;
#else
typedef u64 Word;
#endif
constexpr int BITS = 8 * sizeof(Word), LANES = VECTOR / sizeof(Word), CHUNK = VECTOR / 4;
constexpr int HASHES = BITS > 32 ? BITS / 32 : 1;  // of a word
constexpr int PARTS = BITS < 32 ? 32 / BITS : 1;   // a hash in each 32 bits of so many vectors: lane l has number l / PARTS of part l % PARTS
constexpr int TURN = LANES < 16 ? LANES : 16;      // words of a lane that masks of choices lie in, see turn_masks
constexpr Word FULL = (Word)~0ull;
constexpr u32 ALL = (1u << CHUNK) - 1;  // flags of a chunk
typedef Word V __attribute__((vector_size(VECTOR), may_alias));
typedef Word Turned __attribute__((vector_size(TURN * sizeof(Word)), may_alias));
typedef u64 Wide __attribute__((vector_size(VECTOR), may_alias));
typedef u32 U __attribute__((vector_size(VECTOR), may_alias));
typedef float F __attribute__((vector_size(VECTOR), may_alias));
typedef float Fu __attribute__((vector_size(VECTOR), may_alias, aligned(4)));
typedef int32_t I __attribute__((vector_size(VECTOR), may_alias));
#define ALWAYS static inline __attribute__((always_inline))
#define OUTLINE static __attribute__((noinline))  // what runs once in a while would fill the instruction cache
#define API extern "C" __attribute__((visibility("default")))

ALWAYS V splat(Word x) { return x - V{}; }
ALWAYS F splatf(float x) { return x - F{}; }  // minus keeps -0
ALWAYS U splatu(u32 x) { return x - U{}; }
ALWAYS bool any(V a) {
#if VECTOR == 64
  return _mm512_test_epi64_mask((__m512i)a, (__m512i)a) != 0;
#elif VECTOR == 32
  return !_mm256_testz_si256((__m256i)a, (__m256i)a);
#else
  const Wide wide = (Wide)a;
  return wide[0] | wide[1];
#endif
}
ALWAYS u32 lanes_of(V a) {  // a bit for each world that has any
#if VECTOR == 64 && WIDTH == 16
  return _mm512_test_epi16_mask((__m512i)a, (__m512i)a);
#elif VECTOR == 64 && WIDTH == 32
  return _mm512_test_epi32_mask((__m512i)a, (__m512i)a);
#elif VECTOR == 64
  return _mm512_test_epi64_mask((__m512i)a, (__m512i)a);
#elif VECTOR == 32 && WIDTH == 8
  return (u32)_mm256_movemask_epi8((__m256i)(a != 0));
#elif VECTOR == 32 && WIDTH == 16
  const __m256i some = (__m256i)(a != 0);
  return (u32)_mm_movemask_epi8(_mm_packs_epi16(_mm256_castsi256_si128(some), _mm256_extracti128_si256(some, 1)));
#elif VECTOR == 32 && WIDTH == 32
  return (u32)_mm256_movemask_ps((__m256)(a != 0));
#elif VECTOR == 32
  return (u32)_mm256_movemask_pd((__m256d)(a != 0));
#else
  u32 some = 0;
  for (int l = 0; l < LANES; l++) some |= (u32)(a[l] != 0) << l;
  return some;
#endif
}
// A flag for each lane, as a word of all its bits: one bit each in memory if the processor has masks.
#if VECTOR == 64
typedef u32 Flags;
ALWAYS Flags flags_of(int first, int end) { return (Flags)((1ull << end) - (1ull << first)); }
ALWAYS V words_of(Flags flags) {
#if WIDTH == 16
  return (V)_mm512_maskz_set1_epi16(flags, -1);
#elif WIDTH == 32
  return (V)_mm512_maskz_set1_epi32((__mmask16)flags, -1);
#else
  return (V)_mm512_maskz_set1_epi64((__mmask8)flags, -1);
#endif
}
#else
typedef V Flags;
ALWAYS Flags flags_of(int first, int end) {
  V flags = V{};
  for (int l = first; l < end; l++) flags[l] = FULL;
  return flags;
}
#endif
ALWAYS V words_of(V flags) { return flags; }
ALWAYS bool any_word(const V* row, int words) {
  V some = row[0];
  for (int w = 1; w < words; w++) some |= row[w];
  return any(some);
}
// Compilers refuse to shift words of 16 bits by an int, and shift words of 8 bits one by one.
#if WIDTH == 8
typedef uint16_t Pair __attribute__((vector_size(VECTOR), may_alias));
ALWAYS V right(V x, int by) { return (V)((Pair)x >> (uint16_t)by) & splat(FULL >> by); }
ALWAYS V left(V x, int by) { return (V)((Pair)x << (uint16_t)by) & splat(FULL << by); }
#else
ALWAYS V right(V x, int by) { return x >> (Word)by; }
ALWAYS V left(V x, int by) { return x << (Word)by; }
#endif
ALWAYS V rotated(V x, int by) {  // each word to the right, by less than its width
#if VECTOR == 64 && WIDTH == 16 && defined(__AVX512VBMI2__)
  return (V)_mm512_shrdv_epi16((__m512i)x, (__m512i)x, (__m512i)splat(by));
#elif VECTOR == 64 && WIDTH == 32
  return (V)_mm512_rorv_epi32((__m512i)x, (__m512i)splat(by));
#elif VECTOR == 64 && WIDTH != 16
  return (V)_mm512_rorv_epi64((__m512i)x, (__m512i)splat(by));
#else
  return right(x, by) | left(x, BITS - by);
#endif
}
ALWAYS V mux(V c, V a, V b) { return (c & a) | (~c & b); }
#if VECTOR == 64 || (WIDTH == 8 && defined(__AVX512VBMI__) && defined(__AVX512VL__))
#define SHUFFLES
ALWAYS V two_of(V a, V which, V b) {  // words of a, then of b, by their numbers
#if WIDTH == 8
  return (V)_mm256_permutex2var_epi8((__m256i)a, (__m256i)which, (__m256i)b);
#elif WIDTH == 16
  return (V)_mm512_permutex2var_epi16((__m512i)a, (__m512i)which, (__m512i)b);
#elif WIDTH == 32
  return (V)_mm512_permutex2var_epi32((__m512i)a, (__m512i)which, (__m512i)b);
#else
  return (V)_mm512_permutex2var_epi64((__m512i)a, (__m512i)which, (__m512i)b);
#endif
}
#endif

// The flags of a chunk as bits, and back as a choice between two vectors.
ALWAYS u32 bits_of(I m) {
#if VECTOR == 64 && defined(__AVX512DQ__)
  return _mm512_movepi32_mask((__m512i)m);
#elif VECTOR == 64
  return _mm512_cmplt_epi32_mask((__m512i)m, _mm512_setzero_si512());
#elif VECTOR == 32
  return (u32)_mm256_movemask_ps((__m256)m);
#elif defined(__SSE2__)
  return (u32)_mm_movemask_ps((__m128)m);
#else
  u32 r = 0;
  for (int i = 0; i < CHUNK; i++) r |= (u32)(m[i] & 1) << i;
  return r;
#endif
}
// Comparisons of the floats of a chunk, as bits.
#if VECTOR == 64
#define COMPARE(name, kind, op) ALWAYS u32 name(F a, F b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, kind); }
#else
#define COMPARE(name, kind, op) ALWAYS u32 name(F a, F b) { return bits_of(a op b); }
#endif
COMPARE(bits_eq, _CMP_EQ_OQ, ==)
COMPARE(bits_lt, _CMP_LT_OQ, <)
COMPARE(bits_le, _CMP_LE_OQ, <=)
ALWAYS F blend(u32 bits, F yes, F no) {
#if VECTOR == 64
  return (F)_mm512_mask_blend_ps((__mmask16)bits, (__m512)no, (__m512)yes);
#else
  const I number = NUMBERS, bit = 1 << number;
  const I chosen = ((I)splatu(bits) & bit) != 0;
  return (F)(((I)yes & chosen) | ((I)no & ~chosen));
#endif
}
ALWAYS F choose(I m, F yes, F no) { return (F)(((I)yes & m) | ((I)no & ~m)); }
ALWAYS F root(F a) {
#if VECTOR == 64
  return (F)_mm512_sqrt_ps((__m512)a);
#elif VECTOR == 32
  return (F)_mm256_sqrt_ps((__m256)a);
#else
  F r;
  for (int i = 0; i < CHUNK; i++) r[i] = __builtin_sqrtf(a[i]);
  return r;
#endif
}
ALWAYS F magnitude(F a) { return (F)((I)a & (I)splatu(0x7fffffff)); }
ALWAYS F divide(F a, F b) { return choose(b == 0.0f, splatf(0), a / b); }
// x / d, rounded as a division is: a product with 1/d, and one correction, are exact where nothing over- or underflows.
#if VECTOR == 64
ALWAYS F fused(F a, F b, float c) { return (F)_mm512_fmadd_ps((__m512)b, _mm512_set1_ps(c), (__m512)a); }
#elif VECTOR == 32 && defined(__FMA__)
ALWAYS F fused(F a, F b, float c) { return (F)_mm256_fmadd_ps((__m256)b, _mm256_set1_ps(c), (__m256)a); }
#endif
ALWAYS F divide_by(F x, float d, float inverse) {
#if VECTOR == 64 || (VECTOR == 32 && defined(__FMA__))
  const I size = (I)magnitude(x);
  const I odd = (size < (I)splatf(0x1p-60f)) & (size != 0);
  if (__builtin_expect(bits_of(odd | (size > (I)splatf(0x1p60f))), 0)) return x / splatf(d);
  const F q = x * inverse;
  return fused(q, fused(x, q, -d), inverse);
#else
  (void)inverse;
  return x / splatf(d);
#endif
}
ALWAYS F smaller(F a, F b) { return choose(a < b, a, choose(a != a, a, b)); }
ALWAYS F larger(F a, F b) { return choose(a > b, a, choose(a != a, a, b)); }
ALWAYS F clamped(F x, float lo, float hi, float snap) {
#if VECTOR == 64
  const __mmask16 some = _mm512_cmp_ps_mask((__m512)magnitude(x), _mm512_set1_ps(snap), _CMP_GE_OQ);  // not for a NaN
  return (F)_mm512_maskz_max_ps(some, _mm512_min_ps((__m512)x, _mm512_set1_ps(hi)), _mm512_set1_ps(lo));
#elif VECTOR == 32
  const F within = (F)_mm256_max_ps(_mm256_min_ps((__m256)x, _mm256_set1_ps(hi)), _mm256_set1_ps(lo));
  return (F)((I)within & (magnitude(x) >= snap));  // not for a NaN
#else
  x = choose(x == x, x, splatf(0));
  x = choose(x < lo, splatf(lo), x);
  x = choose(x > hi, splatf(hi), x);
  return choose(magnitude(x) < snap, splatf(0), x);
#endif
}
