// Planes, fields, programs, and the buffers of a thread. Comes after vectors.hpp.

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

constexpr int stride_of(int width) { return (width + CHUNK - 1) / CHUNK * CHUNK + (2 * REACH <= HALO ? HALO : 2 * HALO); }
struct Grid {
  int height;  // of a lane
#if WIDTH
  static constexpr int width = WIDTH, words = WIDTH / BITS, stride = stride_of(width);
#else
  int width, words, stride;
#endif
  int strips;  // of a world, in as many lanes: a power of two; 1 if a lane is a world
  int around_rows, beyond_rows;  // of halos: how far planes are read, on the torus, and with nothing outside
  int cells() const { return height * words; }
  // Strips have halos: behind the rows of a plane lie those above and below on the torus, then the bare ones.
  int above(int y) const { return (height - 1 - y) * words; }  // y < 0
  int below(int y) const { return (around_rows + y) * words; }  // y >= height
  int halos() const { return strips > 1 ? 2 * (around_rows + beyond_rows) * words : 0; }
  int world_height() const { return strips * height; }
  bool operator==(const Grid& g) const { return height == g.height && width == g.width && strips == g.strips; }
};

// The sizes and tables of a program, which the driver reads.
struct ResetPlane { int slot; bool value; };
struct ResetReal { int slot; float value; };
struct FixedPlane { int kind, a, b; };
struct StepPlane { u64 a; int b; };
struct Context;
struct Program {
  int slots, reals, param_planes, param_reals;
  int around_rows, beyond_rows, coins, moving, turned, waiting, marks;  // see NativeLayout of targets/layout.py
  std::vector<ResetPlane> reset_planes;  // slots that a step resets
  std::vector<ResetReal> reset_reals;
  std::vector<FixedPlane> fixed;  // planes of coordinates and insides
  std::vector<StepPlane> steps;   // planes of bits of the step's number
  std::vector<u32> streams;       // their idents
  std::vector<int> elements;      // slots of the bits of element ids
  u64 asked;                      // ids whose presence passes test
  void (*run)(Context&);          // all passes
  std::vector<Context*> contexts;  // free ones: at most a few, of the grids used last
};

// Everything one thread needs to run groups: buffers, row tables, keys.
struct Context {
  Program* program;
  Grid g;
  std::vector<int> wrapped;  // [height + 32]: word offset of row y - 16 on the torus, for strips in the halo
  std::vector<int> lines;    // [height of a world + 32]: row y - 16 of a world on the torus
  std::vector<Plane*> planes;  // free ones
  std::vector<Field*> fields;
  Plane *nothing, *everything;
  Field* calm;  // no row of it is live
  std::vector<void*> memory;  // of the following arrays
  V* nothing_row;
  V *change, *late;  // two rows of words; a row for each plane that moves
  V **from, **to;    // planes that move
  V* entered;   // [height + 1]: the cells that movers enter, in the rows that a movement changes
  int* moving;  // [height + 1]: these rows
  Word* turned;    // masks of choices, lane by lane, see turn_masks
  u32* marks;      // lanes that have anything in a row of some planes, see mark_rows
  float* waiting;  // rows of reals that loops some rows behind read
  float* zeros;
  U world_keys[2][PARTS], strip_starts[PARTS];
  U (*k0)[PARTS], (*k1)[PARTS];  // by stream
  V** coins;     // planes
  bool* tossed;  // whether this step has filled them
  V* step_bits;
  Flags* param_bits;
  float (*param_real)[LANES];
  Plane** slot;
  Field** real;
  V** fixed;  // planes of coordinates and insides, made once
  int lanes, worlds[LANES];  // lanes in use, and the world of each lane; unused lanes are the last world once more
  double* seconds;  // by pass; null if nobody asks
  u64 present;  // the ids that are there, of those that passes ask for; all bits: not known

#if WIDTH
  static constexpr int rest = BITS;
  V valid(int) const { return splat(FULL); }
  int turn(int dx) const { return ((dx % g.width) + g.width) % g.width; }
#else
  int rest;  // columns in the last word of a row
  V valid_last;
  V valid(int w) const { return w == g.words - 1 ? valid_last : splat(FULL); }
  int turns[2 * HALO + 1];
  int turn(int dx) const { return turns[dx + HALO]; }  // dx mod width, for rotations
#endif
  int row(int y) const { return wrapped[y + HALO]; }
  const int* rows() const { return wrapped.data() + HALO; }
};

// Functions of the driver that passes call: through pointers, which pd_program sets, or directly in a file that also has the
// driver.
enum Leaves { NOTHING, EVERYTHING, SAME };  // what movers leave behind
#define SHARED(EACH) \
  EACH(Plane*, take, Context& c) \
  EACH(void, put, Context& c, Plane* p) \
  EACH(Field*, take_field, Context& c) \
  EACH(void, own_plane, Context& c, Plane*& p) \
  EACH(void, own_field, Context& c, Field*& f) \
  EACH(V, columns_far, const Context& c, const V* row, int w, int dx) \
  EACH(void, fill_halo, const Context& c, Plane* p, int rows, bool around) \
  EACH(V, draw_below, const Context& c, int stream, int y, int w, V wanted, int bits, u64 limit) \
  EACH(V, draw_below_flags, const Context& c, int stream, int y, int w, V wanted, int bits, const Flags* limit) \
  EACH(V, draw_below_planes, const Context& c, int stream, int y, int w, V wanted, int bits, const V* limit) \
  EACH(V*, coin_plane, Context& c, int coin, int stream) \
  EACH(float, draw_cell, const Context& c, int stream, int lane, int y, int x, int bits) \
  EACH(Plane*, shifted, Context& c, Plane* p, int dy, int dx) \
  EACH(Plane*, swap_plane, Context& c, Plane* content, const Plane* movers, const Plane* targets, Plane* rest, int dy, int dx) \
  EACH(void, arrive_over, Context& c, Plane* movers, int dy, int dx, Plane* const* olds, Plane** const* news, int count) \
  EACH(void, swap_planes, Context& c, const Plane* movers, int dy, int dx, Plane** const* planes, int count) \
  EACH(void, arrive_planes, Context& c, const Plane* movers, int dy, int dx, Plane** const* planes, int count, Leaves leaves) \
  EACH(Plane*, cleared, Context& c, Plane* old, const Plane* where) \
  EACH(Plane*, joined, Context& c, Plane* old, Plane* where)
#ifdef DRIVER
#define EACH(result, name, ...) OUTLINE result name(__VA_ARGS__);
#else
#define EACH(result, name, ...) inline result (*name)(__VA_ARGS__);
#endif
SHARED(EACH)
#undef EACH

ALWAYS Plane* keep(Plane* p) { p->refs++; return p; }
ALWAYS void give(Context& c, Plane* p) {
  if (--p->refs == 0) put(c, p);
}
ALWAYS Field* keep(Field* f) { f->refs++; return f; }
ALWAYS void give(Context& c, Field* f) {
  if (--f->refs == 0) c.fields.push_back(f);
}
ALWAYS void own(Context& c, Plane*& p) { own_plane(c, p); }
ALWAYS void own(Context& c, Field*& f) { own_field(c, f); }

// Seconds spent in each pass, measured where a call asks for them.
static double thread_seconds() {
  timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
#define START double tick = c.seconds ? thread_seconds() : 0
#define TICK(i) if (c.seconds) { const double now = thread_seconds(); c.seconds[i] += now - tick; tick = now; }
