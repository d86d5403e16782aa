// Planes, fields, and the buffers of a thread. Comes after vectors.hpp.

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
  int cells() const { return height * words; }
  // Strips have halos: behind the rows of a plane lie those above and below on the torus, then the bare ones.
  int above(int y) const { return (height - 1 - y) * words; }  // y < 0
  int below(int y) const { return (AROUND_ROWS + y) * words; }  // y >= height
  int halos() const { return strips > 1 ? 2 * (AROUND_ROWS + BEYOND_ROWS) * words : 0; }
  int world_height() const { return strips * height; }
  bool operator==(const Grid& g) const { return height == g.height && width == g.width && strips == g.strips; }
};

// Everything one thread needs to run groups: buffers, row tables, keys.
struct Context {
  Grid g;
  std::vector<int> wrapped;  // [height + 32]: word offset of row y - 16 on the torus, for strips in the halo
  std::vector<int> lines;    // [height of a world + 32]: row y - 16 of a world on the torus
  std::vector<Plane*> planes;  // free ones
  std::vector<Field*> fields;
  Plane *nothing, *everything;
  Field* calm;  // no row of it is live
  V* nothing_row;
  V *change, *late;  // two rows of words; a row for each plane that moves
  V* entered;   // [height + 1]: the cells that movers enter, in the rows that a movement changes
  int* moving;  // [height + 1]: these rows
  Word* turned;                       // masks of choices, lane by lane, see turn_masks
  static constexpr int masks = TURNED;  // of a word, a multiple of TURN
  u32* marks;      // lanes that have anything in a row of some planes, see mark_rows
  float* waiting;  // rows of reals that loops some rows behind read
  float* zeros;
  U world_keys[2][PARTS], strip_starts[PARTS];
  U k0[STREAMS + 1][PARTS], k1[STREAMS + 1][PARTS];
  V* coins[COINS + 1];      // planes
  bool tossed[COINS + 1];  // whether this step has filled them
  V step_bits[STEP_PLANES + 1];
  Flags param_bits[PARAM_PLANES + 1];
  float param_real[PARAM_REALS + 1][LANES];
  Plane* slot[SLOTS + 1];
  Field* real[REALS + 1];
  std::vector<V*> fixed;  // planes of coordinates and insides, made once
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

template <class T> static T* aligned(size_t count) {
  size_t bytes = (count * sizeof(T) + 127) / 64 * 64;
  void* p = aligned_alloc(64, bytes);
  if (!p) abort();
  memset(p, 0, bytes);
  return (T*)p;
}
// Buffers of batches that are gone are used again: fresh memory from the system costs more than a step.
template <class T> struct Spare {
  Mutex lock;
  size_t size = 0;
  std::vector<T*> waiting;
};
inline Spare<Plane> spare_planes;  // of all units
inline Spare<Field> spare_fields;
static void release(Plane* p) { free(p->data); delete p; }
static void release(Field* f) { free(f->data); free(f->live); delete f; }
template <class T> static T* reuse(Spare<T>& spare, size_t size) {
  Hold hold(spare.lock);
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
    Hold hold(spare.lock);
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

// Not inline: what runs once in a while would fill the processor's instruction cache.
OUTLINE Plane* take(Context& c) {
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
OUTLINE void put(Context& c, Plane* p) { c.planes.push_back(p); }
ALWAYS void give(Context& c, Plane* p) {
  if (--p->refs == 0) put(c, p);
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

// Seconds spent in each pass, measured where a call asks for them.
static double thread_seconds() {
  timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
#define START double tick = c.seconds ? thread_seconds() : 0
#define TICK(i) if (c.seconds) { const double now = thread_seconds(); c.seconds[i] += now - tick; tick = now; }

// Rows of the tables of a program: slots that a step resets, planes that follow from places and from the step.
struct ResetPlane { int slot; bool value; };
struct ResetReal { int slot; float value; };
struct FixedPlane { int kind, a, b; };
struct StepPlane { u64 a; int b; };
