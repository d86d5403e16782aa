// Work on planes: columns and rows of neighbors, draws, movements. Comes after runtime.hpp.

// Columns: the value at the column dx to the right, wrapping or with nothing beyond the edge.
OUTLINE V columns_far(const Context& c, const V* row, int w, int dx) {  // farther than the last word of a row is wide
  const int n = c.g.words, rest = c.rest;
  auto word = [&](int i) -> V {  // words of the endless row: the last is continued by the first
    if (i < 0) return (row[n - 1] << (64 - rest)) | (row[n - 2] >> rest);
    if (i < n - 1) return row[i];
    return i == n - 1 ? row[i] | (row[0] << rest) : (row[0] >> (64 - rest)) | (row[1] << rest);
  };
  V r = dx > 0 ? (word(w) >> dx) | (word(w + 1) << (64 - dx)) : (row[w] << -dx) | (word(w - 1) >> (64 + dx));
  return r & c.valid(w);
}
ALWAYS int next_word(const Context& c, int w, int dx) {  // on the side that dx points to, around
  return dx > 0 ? (w + 1 == c.g.words ? 0 : w + 1) : (w == 0 ? c.g.words - 1 : w - 1);
}
ALWAYS int columns_in(const Context& c, int w) { return w == c.g.words - 1 ? c.rest : 64; }
ALWAYS V columns(const Context& c, const V* row, int w, int dx) {
  if (__builtin_expect(c.g.words != 1, 0)) {
    if (abs(dx) > c.rest) return columns_far(c, row, w, dx);
    const int next = next_word(c, w, dx);
    if (dx > 0) return ((row[w] >> dx) | (row[next] << (columns_in(c, w) - dx))) & c.valid(w);
    return ((row[w] << -dx) | (row[next] >> (columns_in(c, next) + dx))) & c.valid(w);
  }
  const int by = c.turn(dx);
  V x = row[0];
  return by ? ((x >> by) | (x << (c.g.width - by))) & c.valid(0) : x;
}
ALWAYS V columns_zero(const Context& c, const V* row, int w, int dx) {
  V x = dx > 0 ? row[w] >> dx : row[w] << -dx;
  if (dx > 0 && w + 1 < c.g.words) x |= row[w + 1] << (64 - dx);
  if (dx < 0 && w > 0) x |= row[w - 1] >> (64 + dx);
  return x & c.valid(w);
}
ALWAYS const V* row_or_nothing(const Context& c, const Plane* p, int y) {
  if (__builtin_expect(y >= 0 && y < c.g.height, 1)) return p->data + y * c.g.words;
  if (!c.g.strips) return c.nothing_row;
  return p->data + 2 * AROUND_ROWS * c.g.words + (y < 0 ? c.g.above(y) : c.g.below(y) + (BEYOND_ROWS - AROUND_ROWS) * c.g.words);
}

// Strips. What each lane sees `by` lanes on, around.
ALWAYS V turned(V v, int by) {
#if VECTOR == 64
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

// Draws: bit j of 32 columns is one hash; two make a word.
ALWAYS V draw_plane(const Context& c, int stream, int y, int w, int j) {
  u32 across = (c.g.width + 31) / 32;
  u32 n = ((u32)y * across + 2 * w) * 32 + j;
  const I number = NUMBERS;
  U h = (splatu(n) + (U)(number & 1) * 32) * 0x9E3779B1u + c.k0[stream];
  h ^= h >> 16;
  h *= 0x7FEB352Du;
  h ^= h >> 15;
  h = (h + c.k1[stream]) * 0x846CA68Bu;
  h ^= h >> 16;
  return (V)h;
}
// Several planes at once, since the multiplications of one wait for each other.
constexpr int AHEAD = 4;
#define EACH_AHEAD _Pragma("GCC unroll 4") for (int i = 0; i < AHEAD; i++)
struct Drawn { V plane[AHEAD]; };
ALWAYS Drawn draw_planes(const Context& c, int stream, int y, int w, int first) {
  Drawn d;
  EACH_AHEAD d.plane[i] = draw_plane(c, stream, y, w, first + i);
  return d;
}
// Of the cells still open, those whose draw has a 0 where the limit has a 1 are below it; equal bits leave a cell open.
ALWAYS void compare_bit(V& below, V& open, V drawn, V limit) {
  below |= open & limit & ~drawn;
  open &= ~(limit ^ drawn);
}
ALWAYS V limit_bit(u64 limit, int bits, int j) { return splat(0 - (limit >> (bits - 1 - j) & 1)); }
// Which of the wanted cells draw below a constant; stops when all are decided.
OUTLINE V draw_below(const Context& c, int stream, int y, int w, V wanted, int bits, u64 limit) {
  V below = splat(0), open = wanted;
  int j = 0;
  const int last = bits - __builtin_ctzll(limit);
  for (; j + AHEAD <= last && any(open); j += AHEAD) {
    const Drawn d = draw_planes(c, stream, y, w, j);
    EACH_AHEAD compare_bit(below, open, d.plane[i], limit_bit(limit, bits, j + i));
  }
  for (; j < last && any(open); j++) compare_bit(below, open, draw_plane(c, stream, y, w, j), limit_bit(limit, bits, j));
  return below;
}
// The same with a limit given plane by plane, most significant (the carry) first.
OUTLINE V draw_below_planes(const Context& c, int stream, int y, int w, V wanted, int bits, const V* limit) {
  V below = wanted & limit[0], open = wanted & ~limit[0];
  int j = 0;
  for (; j + AHEAD <= bits && any(open); j += AHEAD) {
    const Drawn d = draw_planes(c, stream, y, w, j);
    EACH_AHEAD compare_bit(below, open, d.plane[i], limit[1 + j + i]);
  }
  for (; j < bits && any(open); j++) compare_bit(below, open, draw_plane(c, stream, y, w, j), limit[1 + j]);
  return below;
}
// A row of the highest bit of a draw. Many masks ask for it, in several passes: it is made once a step.
ALWAYS const V* coin_row(Context& c, int coin, int stream, int y) {
  V* row = c.coins[coin] + y * c.g.words;
  if (!c.tossed[coin][y]) {
    c.tossed[coin][y] = 1;
    for (int w = 0; w < c.g.words; w++) row[w] = draw_plane(c, stream, y, w, 0);
  }
  return row;
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
// Rows of one word, not in strips: every row that changes is read and written once. What leaves it for the next one waits
// in a register, and a few planes go together, since each waits for what it reads.
constexpr int TOGETHER = 4;
#define EACH_PLANE _Pragma("GCC unroll 4") for (int k = 0; k < N; k++)
ALWAYS bool near_rows(const Context& c, int dy) { return c.g.words == 1 && !c.g.strips && abs(dy) <= 1; }
template <bool TURNS> ALWAYS V around(V x, int by) { return TURNS ? (x >> by) | (x << (64 - by)) : x; }
template <bool TURNS> ALWAYS V around(const Context& c, V x, int by) {  // `by` columns to the left on the torus
  if (WORDS || !TURNS) return around<TURNS>(x, by);
  return ((x >> by) | (x << (c.g.width - by))) & c.valid(0);
}
// The rows that movers leave or enter, in the direction in which they move, and the cells that they enter.
template <bool TURNS> ALWAYS int rows_of(Context& c, const V* m, int dy, int back) {
  const int height = c.g.height;
  int count = 0, y = dy < 0 ? height - 1 : 0, before = dy > 0 ? height - 1 : 0;  // the row that moves into row y
  for (int i = 0; i < height; i++) {
    const V from = dy ? m[before] : m[y];
    c.entered[y] = around<TURNS>(c, from, back);
    c.moving[count] = y;
    count += any(from | m[y]);
    before = y;
    y += dy < 0 ? -1 : 1;
  }
  return count;
}
template <int N, bool TURNS> ALWAYS void swap_near(const Context& c, V* const* data, const V* m, int rows, int dy, int by, int back) {
  const int edge = dy > 0 ? c.g.height - 1 : 0, first = dy > 0 ? 0 : c.g.height - 1;
  V comes[N], last[N];
  if (dy)
    EACH_PLANE {
      last[k] = (data[k][edge] ^ around<TURNS>(c, data[k][first], by)) & m[edge];
      comes[k] = around<TURNS>(c, last[k], back);
    }
  for (int i = 0; i < rows; i++) {
    const int y = c.moving[i];
    const V gone = m[y];
    EACH_PLANE {
      const V a = data[k][y];
      const V d = dy && y == edge ? last[k] : (a ^ around<TURNS>(c, data[k][y + dy], by)) & gone;
      const V goes = around<TURNS>(c, d, back);
      data[k][y] = a ^ d ^ (dy ? comes[k] : goes);
      comes[k] = goes;
    }
  }
}
template <int N, Leaves LEAVES, bool TURNS> ALWAYS void arrive_near(const Context& c, V* const* data, const V* m, int rows, int dy, int back) {
  const int edge = dy > 0 ? c.g.height - 1 : 0;
  V comes[N];
  if (dy) EACH_PLANE comes[k] = data[k][edge] & m[edge];
  for (int i = 0; i < rows; i++) {
    const int y = c.moving[i];
    const V gone = m[y], entered = c.entered[y];
    EACH_PLANE {
      const V a = data[k][y], goes = a & gone, left = LEAVES == NOTHING ? a & ~gone : LEAVES == EVERYTHING ? a | gone : a;
      data[k][y] = mux(entered, around<TURNS>(c, dy ? comes[k] : goes, back), left);
      comes[k] = goes;
    }
  }
}
template <bool TURNS> ALWAYS void swap_near_rows(Context& c, V* const* data, int count, const V* m, int dy, int by, int back) {
  const int rows = rows_of<TURNS>(c, m, dy, back);
  int k = 0;
  for (; k + TOGETHER <= count; k += TOGETHER) swap_near<TOGETHER, TURNS>(c, data + k, m, rows, dy, by, back);
  for (; k < count; k++) swap_near<1, TURNS>(c, data + k, m, rows, dy, by, back);
}
template <Leaves LEAVES, bool TURNS> ALWAYS void arrive_near_rows(Context& c, V* const* data, int count, const V* m, int dy, int back) {
  const int rows = rows_of<TURNS>(c, m, dy, back);
  int k = 0;
  for (; k + TOGETHER <= count; k += TOGETHER) arrive_near<TOGETHER, LEAVES, TURNS>(c, data + k, m, rows, dy, back);
  for (; k < count; k++) arrive_near<1, LEAVES, TURNS>(c, data + k, m, rows, dy, back);
}
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
// A word's columns, moved by dx: those that stay in the word, and those that come into the next.
ALWAYS V moved_within(const Context& c, V d, int w, int dx) { return (dx > 0 ? d << dx : d >> -dx) & c.valid(w); }
ALWAYS V moved_over(const Context& c, V d, int w, int next, int dx) {
  return (dx > 0 ? d >> (columns_in(c, w) - dx) : d << (columns_in(c, next) + dx)) & c.valid(next);
}
// A row of several words that exchanges with one some columns on. No two movers have a cell in common, so words may
// take turns.
OUTLINE void swap_words(Context& c, const V* m, V* const* data, int n, int here_row, int there_row, int dx) {
  for (int w = 0; w < c.g.words; w++) {
    if (!any(m[w])) continue;
    const int next = next_word(c, w, dx);
    for (int k = 0; k < n; k++) {
      V *here = data[k] + here_row, *there = data[k] + there_row;
      const V d = (here[w] ^ columns(c, there, w, dx)) & m[w];
      here[w] ^= d;
      there[w] ^= moved_within(c, d, w, dx);
      there[next] ^= moved_over(c, d, w, next, dx);
    }
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
  const int words = c.g.words, by = c.turn(dx), back = c.g.width - by;
  if (near_rows(c, dy)) {
    if (by) swap_near_rows<true>(c, data, n, movers->data, dy, by, back);
    else swap_near_rows<false>(c, data, n, movers->data, dy, by, back);
    return;
  }
  for (int y = 0; y < c.g.height; y++) {
    const V* m = movers->data + y * words;
    if (c.g.strips && (u32)(y + dy) >= (u32)c.g.height) {
      const int by = strips_on(c, y + dy);
      if (any_word(m, words)) swap_strips(c, m, data, n, y, y + dy - by * c.g.height, by, dx);
      continue;
    }
    if (words > 1 && dx) {
      if (abs(dx) <= c.rest) {
        swap_words(c, m, data, n, y * words, c.row(y + dy), dx);
        continue;
      }
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
        data[k][there] ^= by ? ((d << by) | (d >> back)) & c.valid(0) : d;  // read again: it may be the same row
      }
    }
  }
}
// Movers go to their targets, at most a row away. A cell that is both holds what arrives: each row is read before
// anything arrives there, and what goes around the edge arrives last.
template <Leaves LEAVES, bool AROUND>
ALWAYS void arrive_row(const Context& c, V* const* data, int count, int here, int there, const V* m, const V* targets, int dx) {
  const int words = c.g.words, by = c.turn(-dx), back = c.g.width - by;
  if (__builtin_expect(words == 1, 1)) {
    const V gone = m[0], keeps = ~targets[0], valid = c.valid(0);
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
  if (here != there && abs(dx) <= c.rest) {
    if (AROUND) memset(c.late, 0, sizeof(V) * count * words);
    for (int w = 0; w < words && !AROUND; w++) {
      if (!any(targets[w])) continue;
      for (int k = 0; k < count; k++) data[k][there + w] &= ~targets[w];
    }
    for (int w = 0; w < words; w++) {
      if (!any(m[w])) continue;
      const int next = next_word(c, w, dx);
      for (int k = 0; k < count; k++) {
        V *from = data[k] + here + w, *to = AROUND ? c.late + k * words : data[k] + there;
        const V moving = *from & m[w];
        if (LEAVES == NOTHING) *from &= ~m[w];
        if (LEAVES == EVERYTHING) *from |= m[w];
        to[w] |= moved_within(c, moving, w, dx);
        if (dx) to[next] |= moved_over(c, moving, w, next, dx);
      }
    }
    return;
  }
  V* moving = c.change + words;
  for (int k = 0; k < count; k++) {
    V *from = data[k] + here, *to = AROUND ? c.late + k * words : data[k] + there;
    for (int w = 0; w < words; w++) {
      moving[w] = splat(0);
      if (!any(m[w])) continue;
      moving[w] = from[w] & m[w];
      if (LEAVES == NOTHING) from[w] &= ~m[w];
      if (LEAVES == EVERYTHING) from[w] |= m[w];
    }
    for (int w = 0; w < words; w++) {
      if (!AROUND && !any(targets[w])) continue;
      const V arriving = dx ? columns(c, moving, w, -dx) : moving[w];
      to[w] = AROUND ? arriving : (to[w] & ~targets[w]) | arriving;
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
  if (near_rows(c, dy)) {
    const int back = c.turn(-dx);
    if (back) arrive_near_rows<LEAVES, true>(c, data, n, movers->data, dy, back);
    else arrive_near_rows<LEAVES, false>(c, data, n, movers->data, dy, back);
    return;
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
