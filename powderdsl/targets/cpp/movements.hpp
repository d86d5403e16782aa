// Operations on whole planes: shifts, movements in place, planes cleared and joined. Comes after memory.hpp.

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
// Strips. The lane that each lane sees `by` lanes on, around those of its world.
ALWAYS V lanes_on(const Context& c, int by) {
  V number;
  for (int l = 0; l < LANES; l++) number[l] = l;
  return mux(splat(c.g.strips - 1), number + splat(by), number);
}
ALWAYS V turned(const Context& c, V v, V lanes) {  // what each lane sees there
  if (c.g.strips == 1) return v;
#ifdef SHUFFLES
  return two_of(v, lanes, v);
#else
  V r;
  for (int l = 0; l < LANES; l++) r[l] = v[lanes[l]];
  return r;
#endif
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
      for (int w = 0; w < words; w++) to[w] = turned(c, from[w], lanes) & kept;
    }
  (around ? p->around : p->beyond) = rows;
}

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
// What movers hold arrives in other planes, which are changed only in rows that movers enter.
OUTLINE void arrive_over(Context& c, Plane* movers, int dy, int dx, Plane* const* olds, Plane** const* news, int count) {
  if (movers->zero) return;
  edges(c, movers, abs(dy));
  V **from = c.from, **to = c.to;
  int n = 0;
  for (int k = 0; k < count; k++) {
    if (olds[k]->zero && (*news[k])->zero) continue;
    edges(c, olds[k], abs(dy));
    own(c, *news[k]);
    (*news[k])->zero = false;
    from[n] = olds[k]->data, to[n++] = (*news[k])->data;
  }
  for (int y = 0; y < c.g.height; y++) {
    const int source = c.row(y - dy), here = y * c.g.words;
    if (!any_word(movers->data + source, c.g.words)) continue;
    for (int w = 0; w < c.g.words; w++) {
      const V targets = columns(c, movers->data + source, w, -dx);
      if (!any(targets)) continue;
      for (int k = 0; k < n; k++) to[k][here + w] = mux(targets, columns(c, from[k] + source, w, -dx), to[k][here + w]);
    }
  }
}
// Planes that move together, in place.
// Rows of one word: every row that changes is read and written once. What leaves it for the next one waits in a register, and
// a few planes go together, since each waits for what it reads.
constexpr int TOGETHER = 4;
#define EACH_PLANE _Pragma("GCC unroll 4") for (int k = 0; k < N; k++)
ALWAYS bool near_rows(const Context& c, int dy) { return c.g.words == 1 && abs(dy) <= 1; }
// `by` columns to the left on the torus.
template <bool TURNS> ALWAYS V around(const Context& c, V x, int by) {
  return TURNS ? around(c, x, by) : x;
}
// The rows that movers leave or enter, in the direction in which they move, and if they are asked for the cells that they
// enter there. The row whose movers go around is the last.
template <bool ENTERED, bool TURNS> ALWAYS int rows_of(const Context& c, const V* m, int dy, int back) {
  const int height = c.g.height;
  int *rows = c.moving, count = 0;
  V before = turned(c, m[dy > 0 ? height - 1 : 0], lanes_on(c, -dy));  // what moves into row y
  for (int i = 0, y = dy < 0 ? height - 1 : 0; i < height; i++, y += dy < 0 ? -1 : 1) {
    const V here = m[y], from = dy ? before : here;
    rows[count] = y;
    if (ENTERED) c.entered[count] = around<TURNS>(c, from, back);
    count += any(from | here);
    before = here;
  }
  return count;
}
// ROWS: whether they move to another row.
template <int N, bool TURNS, bool ROWS> OUTLINE void swap_near(const Context& c, V* const* planes, const V* m, int count, int dy, int by) {
  const int back = c.g.width - by, edge = dy > 0 ? c.g.height - 1 : 0, first = c.g.height - 1 - edge, *rows = c.moving;
  V *data[N], comes[N], last[N];
  EACH_PLANE data[k] = planes[k];
  if (ROWS) {
    const V on = lanes_on(c, dy), from = lanes_on(c, -dy);
    EACH_PLANE {
      last[k] = (data[k][edge] ^ turned(c, around<TURNS>(c, data[k][first], by), on)) & m[edge];
      comes[k] = turned(c, around<TURNS>(c, last[k], back), from);
    }
  }
  const bool wraps = ROWS && count && rows[count - 1] == edge;
  V ahead[N];  // the row after the one that is written
  int loaded = -1;
  for (int i = 0; i < count - wraps; i++) {
    const int y = rows[i];
    const V gone = m[y];
    if (!ROWS || y != loaded) EACH_PLANE ahead[k] = data[k][y];
    EACH_PLANE {
      const V a = ahead[k];
      if (ROWS) ahead[k] = data[k][y + dy];
      const V d = (a ^ around<TURNS>(c, ahead[k], by)) & gone, goes = around<TURNS>(c, d, back);
      data[k][y] = a ^ d ^ (ROWS ? comes[k] : goes);
      comes[k] = goes;
    }
    loaded = y + dy;
  }
  if (wraps) EACH_PLANE data[k][edge] ^= last[k] ^ comes[k];
}
template <bool TURNS, bool ROWS> ALWAYS void swap_near_rows(Context& c, V* const* data, int count, const V* m, int dy, int by) {
  const int rows = rows_of<false, TURNS>(c, m, dy, by);
  int k = 0;
  for (; k + TOGETHER <= count; k += TOGETHER) swap_near<TOGETHER, TURNS, ROWS>(c, data + k, m, rows, dy, by);
  for (; k < count; k++) swap_near<1, TURNS, ROWS>(c, data + k, m, rows, dy, by);
}
// What movers leave in their cells, of all planes: nothing, everything, or what was there.
struct Left {
  V clears, sets;
};
ALWAYS Left left_by(V movers, Leaves leaves) {
  return Left{movers & splat(leaves == NOTHING ? FULL : 0), movers & splat(leaves == EVERYTHING ? FULL : 0)};
}
template <int N, bool TURNS, bool ROWS> OUTLINE void arrive_near(const Context& c, V* const* planes, const V* m, int count, int dy, int back, Leaves leaves) {
  const int *rows = c.moving, edge = dy > 0 ? c.g.height - 1 : 0;
  const V* entered = c.entered;
  V *data[N], comes[N];
  EACH_PLANE data[k] = planes[k];
  if (ROWS) {
    const V from = lanes_on(c, -dy);
    EACH_PLANE comes[k] = turned(c, data[k][edge] & m[edge], from);
  }
  for (int i = 0; i < count; i++) {
    const int y = rows[i];
    const V gone = m[y];
    const Left rest = left_by(gone, leaves);
    const V keeps = ~(rest.clears | entered[i]), sets = rest.sets & keeps;
    EACH_PLANE {
      const V a = data[k][y], goes = a & gone, in = around<TURNS>(c, ROWS ? comes[k] : goes, back);
      data[k][y] = (a & keeps) | in | sets;
      comes[k] = goes;
    }
  }
}
template <bool TURNS, bool ROWS> ALWAYS void arrive_near_rows(Context& c, V* const* data, int count, const V* m, int dy, int back, Leaves leaves) {
  const int rows = rows_of<true, TURNS>(c, m, dy, back);
  int k = 0;
  for (; k + TOGETHER <= count; k += TOGETHER) arrive_near<TOGETHER, TURNS, ROWS>(c, data + k, m, rows, dy, back, leaves);
  for (; k < count; k++) arrive_near<1, TURNS, ROWS>(c, data + k, m, rows, dy, back, leaves);
}
// A row that exchanges with one of other strips, `by` of them on.
OUTLINE void swap_strips(Context& c, const V* m, V* const* data, int n, int here_row, int there_row, int by, int dx) {
  const int words = c.g.words;
  V* seen = c.change + words;
  const V on = lanes_on(c, by), back = lanes_on(c, -by);
  for (int k = 0; k < n; k++) {
    V *here = data[k] + here_row * words, *there = data[k] + there_row * words;
    for (int w = 0; w < words; w++) seen[w] = turned(c, there[w], on);
    for (int w = 0; w < words; w++) c.change[w] = (here[w] ^ (dx ? columns(c, seen, w, dx) : seen[w])) & m[w];
    for (int w = 0; w < words; w++) here[w] ^= c.change[w];
    for (int w = 0; w < words; w++) there[w] ^= turned(c, dx ? columns(c, c.change, w, -dx) : c.change[w], back);
  }
}
// A word's columns, moved by dx: those that stay in the word, and those that come into the next.
ALWAYS V moved_within(const Context& c, V d, int w, int dx) { return (dx > 0 ? left(d, dx) : right(d, -dx)) & c.valid(w); }
ALWAYS V moved_over(const Context& c, V d, int w, int next, int dx) {
  return (dx > 0 ? right(d, columns_in(c, w) - dx) : left(d, columns_in(c, next) + dx)) & c.valid(next);
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
  V** const data = c.to;
  int n = 0;
  for (int k = 0; k < count; k++) {
    Plane*& p = *planes[k];
    if (p->zero) continue;
    own(c, p);
    data[n++] = p->data;
  }
  const int words = c.g.words, by = c.turn(dx), back = c.g.width - by;
  if (!dy && !by) return;  // around the whole world, to itself
  if (near_rows(c, dy)) {
    if (!by) swap_near_rows<false, true>(c, data, n, movers->data, dy, by);
    else if (dy) swap_near_rows<true, true>(c, data, n, movers->data, dy, by);
    else swap_near_rows<true, false>(c, data, n, movers->data, dy, by);
    return;
  }
  for (int y = 0; y < c.g.height; y++) {
    const V* m = movers->data + y * words;
    if (c.g.strips > 1 && (u32)(y + dy) >= (u32)c.g.height) {
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
        const V d = (a ^ (by ? around(c, b, by) : b)) & m[w];
        data[k][here] = a ^ d;
        data[k][there] ^= by ? around(c, d, back) : d;  // read again: it may be the same row
      }
    }
  }
}
// Rows of several words: movers go to their targets, at most a row away. A cell that is both holds what arrives: each row is
// read before anything arrives there, and what goes around the edge arrives last.
template <bool AROUND>
ALWAYS void arrive_row(const Context& c, V* const* data, int count, int here, int there, const V* m, const V* targets, int dx, Leaves leaves) {
  const int words = c.g.words;
  if (here != there && abs(dx) <= c.rest) {
    if (AROUND) memset(c.late, 0, sizeof(V) * count * words);
    for (int w = 0; w < words && !AROUND; w++) {
      if (!any(targets[w])) continue;
      for (int k = 0; k < count; k++) data[k][there + w] &= ~targets[w];
    }
    for (int w = 0; w < words; w++) {
      if (!any(m[w])) continue;
      const int next = next_word(c, w, dx);
      const Left rest = left_by(m[w], leaves);
      for (int k = 0; k < count; k++) {
        V *from = data[k] + here + w, *to = AROUND ? c.late + k * words : data[k] + there;
        const V moving = *from & m[w];
        *from = (*from & ~rest.clears) | rest.sets;
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
      const Left rest = left_by(m[w], leaves);
      moving[w] = from[w] & m[w];
      from[w] = (from[w] & ~rest.clears) | rest.sets;
    }
    for (int w = 0; w < words; w++) {
      if (!AROUND && !any(targets[w])) continue;
      const V arriving = dx ? columns(c, moving, w, -dx) : moving[w];
      to[w] = AROUND ? arriving : (to[w] & ~targets[w]) | arriving;
    }
  }
}
OUTLINE void arrive_planes(Context& c, const Plane* movers, int dy, int dx, Plane** const* planes, int count, Leaves leaves) {
  if (movers->zero || (!dy && !c.turn(dx))) return;
  V** const data = c.to;
  int n = 0;
  for (int k = 0; k < count; k++) {
    Plane*& p = *planes[k];
    if (p->zero && leaves != EVERYTHING) continue;
    own(c, p);
    p->zero = false;
    data[n++] = p->data;
  }
  if (near_rows(c, dy)) {
    const int back = c.turn(-dx);
    if (!back) arrive_near_rows<false, true>(c, data, n, movers->data, dy, back, leaves);
    else if (dy) arrive_near_rows<true, true>(c, data, n, movers->data, dy, back, leaves);
    else arrive_near_rows<true, false>(c, data, n, movers->data, dy, back, leaves);
    return;
  }
  const int words = c.g.words, height = c.g.height;
  V* targets = c.change;
  for (int i = 0, y = dy > 0 ? height - 1 : 0; i < height; i++, y += dy > 0 ? -1 : 1) {
    const V* m = movers->data + y * words;
    if (!any_word(m, words)) continue;
    for (int w = 0; w < words; w++) targets[w] = dx ? columns(c, m, w, -dx) : m[w];
    if (y + dy < 0 || y + dy >= height) arrive_row<true>(c, data, n, y * words, 0, m, targets, dx, leaves);
    else arrive_row<false>(c, data, n, y * words, (y + dy) * words, m, targets, dx, leaves);
  }
  const int edge = dy > 0 ? height - 1 : 0;
  const V* m = movers->data + edge * words;
  if (!dy || !any_word(m, words)) return;
  const V back = lanes_on(c, -dy);
  for (int w = 0; w < words; w++) targets[w] = turned(c, dx ? columns(c, m, w, -dx) : m[w], back);
  for (int k = 0; k < n; k++) {
    V* there = data[k] + (dy > 0 ? 0 : height - 1) * words;
    for (int w = 0; w < words; w++) there[w] = (there[w] & ~targets[w]) | turned(c, c.late[k * words + w], back);
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
