// Columns and rows of neighbors in planes, and rows of reals. Comes after runtime.hpp.

// Columns: the value at the column dx to the right, wrapping or with nothing beyond the edge.
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
  return p->data + 2 * c.g.around_rows * c.g.words + (y < 0 ? c.g.above(y) : c.g.below(y) + (c.g.beyond_rows - c.g.around_rows) * c.g.words);
}

ALWAYS int strips_on(const Context& c, int y) {  // how many strips below its own the row y of a strip lies
  return y >= 0 ? y / c.g.height : -((c.g.height - 1 - y) / c.g.height);
}
// To be called before rows of other strips are read, up to `rows` away.
ALWAYS void edges(const Context& c, Plane* p, int rows) {
  if (c.g.strips > 1 && p->around < rows) fill_halo(c, p, rows, true);
}
ALWAYS void bare_edges(const Context& c, Plane* p, int rows) {
  if (c.g.strips > 1 && p->beyond < rows) fill_halo(c, p, rows, false);
}

// Rows of reals.
// After the chunks of a row: the halo, as far as columns are read beyond the edges.
template <int FAR = REACH> ALWAYS void finish_row(const Grid& g, float* row) {
  const int w = g.width;
  if (__builtin_expect(w >= FAR, 1)) {
    for (int i = 0; i < FAR; i++) row[w + i] = row[i];
    for (int i = 1; i <= FAR; i++) row[-i] = row[w - i];
  } else {
    for (int i = 0; i < FAR; i++) row[w + i] = row[i % w];
    for (int i = 1; i <= FAR; i++) row[-i] = row[(w - i % w) % w];
  }
}
template <int FAR> ALWAYS void bare_row(const Grid& g, float* row) {  // zeros instead
  for (int i = 0; i < FAR; i++) row[g.width + i] = row[-1 - i] = 0;
}
ALWAYS float* row_of(const Context& c, const Field& f, int line) { return f.data + (size_t)line * c.g.stride + HALO; }
static void copy_floats(const Grid& g, float* to, const float* from) {  // a row and its halo
  memcpy(to - REACH, from - REACH, sizeof(float) * (g.width + 2 * REACH));
}
ALWAYS F load(const float* row, int x) { return (F)*(const Fu*)(row + x); }
