// Batches of worlds, packing, threads and the entry points. Comes after movements.hpp and draws.hpp.
#include <unistd.h>

struct Group {
  Plane** slot;
  Field** real;
  u64 present;  // as in a context, after the last run; not known where planes have been written to since
};
struct Batch {
  Program* program;
  Grid g;
  int worlds;
  std::vector<Group> groups;
  std::vector<Plane*> slots;  // of all groups
  std::vector<Field*> reals;
  std::vector<uint8_t> idle;  // whether each world's cells do not matter; empty: they all do
  int lanes() const { return worlds * g.strips; }  // what lies side by side, in all groups
  bool is_idle(int world) const { return !idle.empty() && idle[world]; }
  // Whether all worlds of a group are idle, so that it can be skipped.
  bool rests(int group) const {
    const int first = group * LANES / g.strips, last = std::min(worlds, ((group + 1) * LANES + g.strips - 1) / g.strips);
    return !idle.empty() && std::all_of(&idle[first], &idle[first] + (last - first), [](uint8_t each) { return each != 0; });
  }
  // Where a lane's cells begin in arrays of worlds; `apart`: from one world to the next, `row`: from row to row.
  int64_t at(int lane, int64_t apart, int64_t row) const {
    return lane / g.strips * apart + lane % g.strips * g.height * row;
  }
};

constexpr size_t LARGE_PLANE = 32 << 10;  // bytes from which a plane of LANES worlds is too large to be kept near
constexpr int GROUP_WORK = 8;             // what a step of a group costs beside that of its words, in words
// Strips fill lanes where few worlds run, and keep less at hand where worlds are large.
static Grid make_grid(const Program& program, int worlds, int height, int width) {
  const int words = (width + BITS - 1) / BITS, least_rows = std::max({1, program.around_rows, program.beyond_rows});  // only the next strip is asked
  const bool large = sizeof(V) * height * words >= LARGE_PLANE;
  Grid g;
  int64_t least = INT64_MAX;
  for (int strips = 1; strips <= LANES && height % strips == 0 && (strips == 1 || height / strips >= least_rows); strips *= 2) {
    const int64_t groups = ((int64_t)worlds * strips + LANES - 1) / LANES, work = groups * (height / strips * words + GROUP_WORK);
    if (work < least || large) least = work, g.strips = strips;
  }
  g.height = height / g.strips, g.around_rows = program.around_rows, g.beyond_rows = program.beyond_rows;
#if !WIDTH
  g.width = width, g.words = words, g.stride = stride_of(width);
#endif
  return g;
}
static bool fixed_flag(const FixedPlane& f, const Grid& g, int lane, int y, int x) {
  y += lane % g.strips * g.height;
  switch (f.kind) {
    case 0: return (y % f.a) >> f.b & 1;
    case 1: return (x % f.a) >> f.b & 1;
    default: return y + f.a >= 0 && y + f.a < g.world_height() && x + f.b >= 0 && x + f.b < g.width;
  }
}
// A number for each hash of a vector of words, from its lane.
template <class Of> ALWAYS void by_hash(U* parts, Of of) {
  for (int l = 0; l < LANES; l++) {
    const u32 number = of(l);
    for (int i = 0; i < HASHES; i++) parts[l % PARTS][l / PARTS * HASHES + i] = number;
  }
}
static Context* new_context(Program& program, const Grid& g) {
  Context* c = new (std::align_val_t(64)) Context();
  c->program = &program;
  c->g = g;
#if !WIDTH
  c->rest = g.width - BITS * (g.words - 1);
  c->valid_last = splat(FULL >> (BITS - c->rest));
  for (int dx = -HALO; dx <= HALO; dx++) c->turns[dx + HALO] = ((dx % g.width) + g.width) % g.width;
#endif
  const int whole = g.world_height();
  for (int y = -HALO; y < whole + HALO; y++) c->lines.push_back(((y % whole) + whole) % whole);
  for (int y = -HALO; y < g.height + HALO; y++) {
    if (g.strips == 1) c->wrapped.push_back(c->lines[y + HALO] * g.words);
    else c->wrapped.push_back(y < 0 ? g.above(y) : y < g.height ? y * g.words : g.below(y));
  }
  c->nothing = new Plane{aligned<V>(g.cells() + g.halos()), 1, true, 0, 0};
  c->everything = new Plane{aligned<V>(g.cells() + g.halos()), 1, false, 0, 0};
  for (int i = 0; i < g.cells(); i++) c->everything->data[i] = c->valid(i % g.words);
  c->calm = new Field{nullptr, aligned<uint8_t>(LANES * g.height), 1, true};
  auto room = [&](auto*& array, size_t count) {
    array = aligned<std::remove_reference_t<decltype(*array)>>(count);
    c->memory.push_back(array);
  };
  room(c->nothing_row, g.words), room(c->change, 2 * g.words), room(c->late, (program.moving + 1) * g.words);
  room(c->from, program.moving), room(c->to, program.moving), room(c->entered, g.height + 1), room(c->moving, g.height + 1);
  const u32 across = (g.width + 31) / 32;
  by_hash(c->strip_starts, [&](int l) { return l % g.strips * g.height * across * 32 * APART; });
  room(c->zeros, g.stride + HALO + CHUNK), room(c->waiting, (size_t)program.waiting * g.stride + HALO + CHUNK);
  room(c->turned, (size_t)LANES * g.height * g.words * program.turned), room(c->marks, (size_t)program.marks * g.height);
  room(c->k0, program.streams.size()), room(c->k1, program.streams.size());
  room(c->step_bits, program.steps.size()), room(c->param_bits, program.param_planes), room(c->param_real, program.param_reals);
  room(c->slot, program.slots), room(c->real, program.reals), room(c->coins, program.coins), room(c->tossed, program.coins);
  room(c->fixed, program.fixed.size());
  for (int i = 0; i < program.coins; i++) room(c->coins[i], g.cells());
  for (size_t i = 0; i < program.fixed.size(); i++) {
    V*& plane = c->fixed[i];
    room(plane, g.cells());
    for (int y = 0; y < g.height; y++)
      for (int x = 0; x < g.width; x++)
        for (int l = 0; l < LANES; l++) plane[y * g.words + x / BITS][l] |= (Word)fixed_flag(program.fixed[i], g, l, y, x) << (x % BITS);
  }
  return c;
}
static void free_context(Context* c) {
  for (Plane* p : c->planes) drop(c->g, p);
  for (Field* f : c->fields) drop(c->g, f);
  release(c->nothing);
  release(c->everything);
  release(c->calm);
  for (void* array : c->memory) free(array);
  c->~Context();
  operator delete(c, std::align_val_t(64));
}

static Mutex contexts_lock;
static Context* borrow(Program& program, const Grid& g) {
  Hold hold(contexts_lock);
  std::vector<Context*>& contexts = program.contexts;
  for (size_t i = 0; i < contexts.size(); i++)
    if (contexts[i]->g == g) {
      Context* c = contexts[i];
      contexts.erase(contexts.begin() + i);
      return c;
    }
  return new_context(program, g);
}
static void put_back(Context* c) {
  Hold hold(contexts_lock);
  std::vector<Context*>& contexts = c->program->contexts;
  contexts.push_back(c);
  if (contexts.size() > 16) {
    free_context(contexts.front());
    contexts.erase(contexts.begin());
  }
}

static void reset_slots(Context& c) {
  for (const ResetPlane& r : c.program->reset_planes) {
    give(c, c.slot[r.slot]);
    c.slot[r.slot] = keep(r.value ? c.everything : c.nothing);
  }
  for (const ResetReal& r : c.program->reset_reals) {
    give(c, c.real[r.slot]);
    if (r.value == 0) {
      c.real[r.slot] = keep(c.calm);
      continue;
    }
    Field* f = c.real[r.slot] = take_field(c);
    memset(f->live, 1, LANES * c.g.height);
    f->still = false;
    std::fill(f->data, f->data + field_floats(c.g), r.value);
  }
}
struct Clocks {
  const u64 *seed, *index, *step;
  u64 since;  // steps after `step`
};
static void begin_step(Context& c, const Clocks& k, long done) {
  const Program& program = *c.program;
  U step[PARTS];
  by_hash(step, [&](int l) { return (u32)(k.step[c.worlds[l]] + done); });
  for (int i = 0; i < PARTS; i++) {
    const U first = mix(c.world_keys[0][i] + step[i]), second = mix(c.world_keys[1][i] + step[i]);
    for (size_t s = 0; s < program.streams.size(); s++) {
      c.k0[s][i] = mix(first + splatu(program.streams[s])) + c.strip_starts[i];
      c.k1[s][i] = mix(second + splatu(program.streams[s]));
    }
  }
  std::fill_n(c.tossed, program.coins, false);
  for (size_t i = 0; i < program.steps.size(); i++)
    for (int l = 0; l < LANES; l++) {
      const u64 step = k.step[c.worlds[l]] + done;
      c.step_bits[i][l] = (step % program.steps[i].a) >> program.steps[i].b & 1 ? FULL : 0;
    }
}
// Finds which of the ids that passes ask for are present, from products of their low and high bits.
static void look(Context& c) {
  const std::vector<int>& elements = c.program->elements;
  const int bits = elements.size(), low = bits / 2;
  const u64 asked = c.program->asked;
  V found[64] = {};
  for (int i = 0; i < c.g.cells(); i++) {
    V part[2][16];
    part[0][0] = part[1][0] = splat(FULL);
    for (int bit = 0; bit < bits; bit++) {
      const V flags = c.slot[elements[bit]]->data[i];
      V* products = part[bit >= low];
      const int count = 1 << (bit < low ? bit : bit - low);
      for (int k = 0; k < count; k++) products[count + k] = products[k] & flags, products[k] &= ~flags;
    }
    for (u64 ids = asked; ids; ids &= ids - 1) {
      const int id = __builtin_ctzll(ids);
      found[id] |= part[0][id & ((1 << low) - 1)] & part[1][id >> low];
    }
  }
  c.present = 0;
  for (int id = 0; id < 64; id++) c.present |= (u64)any(found[id]) << id;
}
// The bits and numbers of each world, one after another; of one world, unless each has its `own`.
struct Parameters {
  bool own;
  const uint8_t* bits;
  const float* reals;
};
static void load_parameters(Context& c, const Parameters& parameters) {
  const int planes = c.program->param_planes, numbers = c.program->param_reals;
  for (int first = 0, end; first < LANES; first = end) {  // lanes with the same parameters
    const int world = parameters.own ? c.worlds[first] : 0;
    for (end = first + 1; end < LANES && (!parameters.own || c.worlds[end] == world);) end++;
    const Flags lanes = flags_of(first, end);
    const uint8_t* bits = parameters.bits + (size_t)world * planes;
    const float* reals = parameters.reals + (size_t)world * numbers;
    for (int i = 0; i < planes; i++) c.param_bits[i] = (first ? c.param_bits[i] : Flags{}) | (bits[i] ? lanes : Flags{});
    for (int i = 0; i < numbers; i++) std::fill(c.param_real[i] + first, c.param_real[i] + end, reals[i]);
  }
}
static void run_group(Context& c, Batch& b, int number, long steps, const Clocks& k, const Parameters& parameters) {
  c.lanes = std::min(LANES, b.lanes() - number * LANES);
  for (int l = 0; l < LANES; l++) c.worlds[l] = (number * LANES + std::min(l, c.lanes - 1)) / c.g.strips;
  load_parameters(c, parameters);
  for (int i = 0; i < 2; i++) {
    int last = -1;  // strips of a world have the same key
    u32 key = 0;
    by_hash(c.world_keys[i], [&](int l) {
      const int world = c.worlds[l];
      if (world != last) key = world_key(k.seed[world], k.index[world], i), last = world;
      return key;
    });
  }
  const Program& program = *c.program;
  Group& group = b.groups[number];
  for (int i = 0; i < program.slots; i++) {
    c.slot[i] = group.slot[i];
    if (c.slot[i]->zero) {  // an empty plane of a batch may hold anything
      give(c, c.slot[i]);
      c.slot[i] = keep(c.nothing);
    }
  }
  for (int i = 0; i < program.reals; i++) c.real[i] = group.real[i];
  c.present = group.present;
  for (long s = 0; s < steps; s++) {
    begin_step(c, k, (long)k.since + s);
    reset_slots(c);
    if (program.asked && c.present == ~0ull) look(c);
    program.run(c);
  }
  for (int i = 0; i < program.slots; i++) own(c, c.slot[i]), group.slot[i] = c.slot[i];
  for (int i = 0; i < program.reals; i++) own(c, c.real[i]), group.real[i] = c.real[i];
  group.present = c.present;
}

#if !defined(__wasm__)
// Threads that wait for work; the caller is one of them.
struct Pool {
  Mutex lock;
  std::condition_variable wake, done;
  std::vector<std::thread> threads;
  std::function<void(int)> job;
  long round = 0;
  int running = 0, wanted = 0;
  void work(int id) {
    long seen = 0;
    for (;;) {
      std::function<void(int)> mine;
      {
        std::unique_lock<std::mutex> hold(lock);
        wake.wait(hold, [&] { return round != seen; });
        seen = round;
        if (id >= wanted) continue;
        mine = job;
      }
      mine(id);
      Hold hold(lock);
      if (--running == 0) done.notify_one();
    }
  }
  void run(int count, std::function<void(int)> task) {
    {
      Hold hold(lock);
      while ((int)threads.size() < count - 1) {
        int id = (int)threads.size() + 1;
        threads.emplace_back([this, id] { work(id); });
        threads.back().detach();
      }
      job = task;
      wanted = count;
      running = count - 1;
      round++;
    }
    wake.notify_all();
    task(0);
    std::unique_lock<std::mutex> hold(lock);
    done.wait(hold, [&] { return running == 0; });
  }
};
static Mutex pool_use;
static Pool& pool() {  // never destroyed: its threads may outlive main
  static Pool* p = new Pool();
  static pid_t owner = getpid();
  if (getpid() != owner) p = new Pool(), owner = getpid();  // a fork has none of its parent's threads
  return *p;
}
#endif
// Calls a task on `count` threads; the caller is one of them.
static void on_threads(int count, const std::function<void(int)>& task) {
#if !defined(__wasm__)
  if (count > 1) {
    Hold hold(pool_use);
    pool().run(count, task);
    return;
  }
#endif
  task(0);
}

// Bit `bit` of the cells of a word. Eight bytes at a time: a product moves their lowest bits into one byte.
template <class T> ALWAYS Word word_of_cells(const T* cell, int count, int bit) {
  Word word = 0;
  int x = 0;
  if (sizeof(T) == 1)
    for (; x + 8 <= count; x += 8) {
      u64 eight;
      memcpy(&eight, cell + x, 8);
      word |= (Word)((eight >> bit & 0x0101010101010101ull) * 0x0102040810204080ull >> 56) << x;
    }
  for (; x < count; x++) word |= (Word)((u64)cell[x] >> bit & 1) << x;
  return word;
}
template <class T> static void load_values(Batch& b, int slot, int bits, const T* data) {
  const Grid& g = b.g;
  for (size_t n = 0; n < b.groups.size(); n++) {
    b.groups[n].present = ~0ull;
    for (int i = 0; i < bits; i++) {
      Plane* p = b.groups[n].slot[slot + i];
      memset(p->data, 0, sizeof(V) * g.cells());
      bool some = false;
      for (int l = 0; l < std::min(LANES, b.lanes() - (int)n * LANES); l++) {
        const T* cell = data + ((size_t)n * LANES + l) * g.height * g.width;
        Word* out = (Word*)p->data;
        for (int y = 0; y < g.height; y++)
          for (int w = 0; w < g.words; w++) {
            int count = std::min(BITS, g.width - BITS * w);
            Word word = word_of_cells(cell, count, i);
            cell += count;
            some |= word != 0;
            out[(y * g.words + w) * LANES + l] = word;
          }
      }
      p->zero = !some;
      p->around = p->beyond = 0;
    }
  }
}

static Batch* new_batch(Program& program, int worlds, const Grid& g) {
  Batch* b = new Batch{&program, g, worlds};
  b->groups.resize((b->lanes() + LANES - 1) / LANES);
  b->slots.resize(b->groups.size() * program.slots), b->reals.resize(b->groups.size() * program.reals);
  for (size_t n = 0; n < b->groups.size(); n++) {
    Group& group = b->groups[n];
    group = {b->slots.data() + n * program.slots, b->reals.data() + n * program.reals, ~0ull};
    for (int i = 0; i < program.slots; i++) {
      Plane* p = group.slot[i] = new_plane(g);
      p->refs = 1;
      p->zero = true;
      p->around = p->beyond = 0;
    }
    for (int i = 0; i < program.reals; i++) {
      Field* f = group.real[i] = new_field(b->g);
      f->refs = 1;
      f->still = true;
      memset(f->live, 0, LANES * g.height);
    }
  }
  return b;
}
// Worlds of a width that the library is for. `running`: about how many are not idle; 0: all.
API void* pd_new(Program* program, int worlds, int height, int width, int running) {
  return new_batch(*program, worlds, make_grid(*program, running ? running : worlds, height, width));
}
API void pd_free(void* batch) {
  Batch* b = (Batch*)batch;
  for (Plane* p : b->slots) drop(b->g, p);
  for (Field* f : b->reals) drop(b->g, f);
  delete b;
}
API void* pd_copy(const void* batch) {
  const Batch* a = (const Batch*)batch;
  Batch* b = new_batch(*a->program, a->worlds, a->g);
  for (size_t n = 0; n < a->groups.size(); n++) {
    b->groups[n].present = a->groups[n].present;
    for (int i = 0; i < b->program->slots; i++) {
      const Plane* from = a->groups[n].slot[i];
      Plane* to = b->groups[n].slot[i];
      if (!from->zero) memcpy(to->data, from->data, sizeof(V) * a->g.cells());
      to->zero = from->zero;
    }
    for (int i = 0; i < b->program->reals; i++) {
      const Field* from = a->groups[n].real[i];
      Field* to = b->groups[n].real[i];
      memcpy(to->live, from->live, LANES * a->g.height);
      to->still = from->still;
      for (int r = 0; r < LANES * a->g.height; r++)
        if (from->live[r]) copy_floats(a->g, to->data + (size_t)r * a->g.stride + HALO, from->data + (size_t)r * a->g.stride + HALO);
    }
  }
  return b;
}
static void load_reals(Batch& b, int slot, const float* data, int64_t apart) {
  for (Group& group : b.groups) {
    group.real[slot]->still = true;
    memset(group.real[slot]->live, 0, LANES * b.g.height);
  }
  for (int lane = 0; lane < b.lanes(); lane++) {
    Field* f = b.groups[lane / LANES].real[slot];
    const float* cells = data + b.at(lane, apart, b.g.width);
    for (int y = 0; y < b.g.height; y++) {
      int r = lane % LANES * b.g.height + y;
      float* row = f->data + (size_t)r * b.g.stride + HALO;
      memcpy(row, cells + (int64_t)y * b.g.width, sizeof(float) * b.g.width);
      f->live[r] = std::any_of(row, row + b.g.width, [](float v) { return v != 0; });
      if (f->live[r]) f->still = false;
      finish_row(b.g, row);
    }
  }
}
// In the following functions, slots without bits are floats, and `item` is the bytes of a cell.
API void pd_load(void* batch, int slot, int bits, int item, const void* data, int64_t apart) {
  Batch& b = *(Batch*)batch;
  if (!bits) load_reals(b, slot, (const float*)data, apart);
  else if (item == 1) load_values(b, slot, bits, (const uint8_t*)data);
  else if (item == 2) load_values(b, slot, bits, (const int16_t*)data);
  else load_values(b, slot, bits, (const int32_t*)data);
}
// Some worlds of a batch anew, from arrays of these worlds alone: the lanes of world places[k] from the k-th world.
template <class Visit> static void in_places(Batch& b, int count, const int64_t* places, Visit visit) {
  for (int k = 0; k < count; k++)
    for (int strip = 0; strip < b.g.strips; strip++) {
      const int lane = (int)places[k] * b.g.strips + strip;
      visit(b.groups[lane / LANES], lane % LANES, ((int64_t)k * b.g.world_height() + strip * b.g.height) * b.g.width);
    }
}
template <class T> static void put_values(Batch& b, int slot, int bits, int count, const int64_t* places, const T* data) {
  in_places(b, count, places, [&](Group& group, int lane, int64_t begin) {
    group.present = ~0ull;
    for (int i = 0; i < bits; i++) {
      Plane* p = group.slot[slot + i];
      p->around = p->beyond = 0;
      const T* cell = data + begin;
      for (int y = 0; y < b.g.height; y++)
        for (int w = 0; w < b.g.words; w++) {
          const int many = std::min(BITS, b.g.width - BITS * w);
          const Word word = word_of_cells(cell, many, i);
          cell += many;
          if (p->zero && !word) continue;  // a plane that holds nothing goes on being skipped
          if (p->zero) memset(p->data, 0, sizeof(V) * b.g.cells());
          p->zero = false;
          ((Word*)p->data)[((size_t)y * b.g.words + w) * LANES + lane] = word;
        }
    }
  });
}
static void put_reals(Batch& b, int slot, int count, const int64_t* places, const float* data) {
  in_places(b, count, places, [&](Group& group, int lane, int64_t begin) {
    Field* f = group.real[slot];
    for (int y = 0; y < b.g.height; y++) {
      const size_t r = (size_t)lane * b.g.height + y;
      float* row = f->data + r * b.g.stride + HALO;
      memcpy(row, data + begin + (int64_t)y * b.g.width, sizeof(float) * b.g.width);
      f->live[r] = std::any_of(row, row + b.g.width, [](float v) { return v != 0; });
      if (f->live[r]) f->still = false;
      finish_row(b.g, row);
    }
  });
}
API void pd_put(void* batch, int slot, int bits, int item, const void* data, int count, const int64_t* places) {
  Batch& b = *(Batch*)batch;
  if (!bits) put_reals(b, slot, count, places, (const float*)data);
  else if (item == 1) put_values(b, slot, bits, count, places, (const uint8_t*)data);
  else if (item == 2) put_values(b, slot, bits, count, places, (const int16_t*)data);
  else put_values(b, slot, bits, count, places, (const int32_t*)data);
}

// One box of cells in each world: int64 [worlds][4], first row, the one after the last, first column, the one after the
// last; empty where nothing changes. Visits the rows of each lane that lie in it.
template <class Visit> static void in_boxes(Batch& b, const int64_t* boxes, Visit visit) {
  for (int lane = 0; lane < b.lanes(); lane++) {
    const int world = lane / b.g.strips;
    const int64_t *box = boxes + 4 * world, top = lane % b.g.strips * b.g.height;
    const int first = (int)std::max<int64_t>(box[0] - top, 0), last = (int)std::min<int64_t>(box[1] - top, b.g.height);
    if (first < last && box[2] < box[3]) visit(b.groups[lane / LANES], lane % LANES, world, first, last, box);
  }
}
static void fill_values(Batch& b, int slot, int bits, const int64_t* boxes, const int64_t* values) {
  in_boxes(b, boxes, [&](Group& group, int lane, int world, int first, int last, const int64_t* box) {
    group.present = ~0ull;
    for (int i = 0; i < bits; i++) {
      Plane* p = group.slot[slot + i];
      const bool set = values[world] >> i & 1;
      if (p->zero && !set) continue;
      if (p->zero) memset(p->data, 0, sizeof(V) * b.g.cells());
      p->zero = false;
      p->around = p->beyond = 0;
      for (int w = 0; w < b.g.words; w++) {
        const int from = (int)std::max<int64_t>(box[2] - BITS * w, 0), to = (int)std::min<int64_t>(box[3] - BITS * w, BITS);
        if (from >= to) continue;
        const Word mask = FULL >> (BITS - (to - from)) << from;
        for (int y = first; y < last; y++) {
          Word& word = ((Word*)p->data)[((size_t)y * b.g.words + w) * LANES + lane];
          word = set ? word | mask : word & ~mask;
        }
      }
    }
  });
}
static void fill_reals(Batch& b, int slot, const int64_t* boxes, const float* values) {
  in_boxes(b, boxes, [&](Group& group, int lane, int world, int first, int last, const int64_t* box) {
    Field* f = group.real[slot];
    for (int y = first; y < last; y++) {
      const size_t r = (size_t)lane * b.g.height + y;
      float* row = f->data + r * b.g.stride + HALO;
      if (!f->live[r] && values[world] == 0) continue;
      if (!f->live[r]) std::fill_n(row, b.g.width, 0.f);
      std::fill(row + box[2], row + box[3], values[world]);
      f->live[r] = values[world] != 0 || std::any_of(row, row + b.g.width, [](float v) { return v != 0; });
      if (f->live[r]) f->still = false;
      finish_row(b.g, row);
    }
  });
}
API void pd_fill(void* batch, int slot, int bits, const void* values, const int64_t* boxes) {
  Batch& b = *(Batch*)batch;
  if (bits) fill_values(b, slot, bits, boxes, (const int64_t*)values);
  else fill_reals(b, slot, boxes, (const float*)values);
}
// Runs a batch, or a copy of it, and returns what has run. `seconds`: null, or to which each pass adds its time.
API void* pd_run(void* batch, int copy, int64_t steps, int threads, const u64* seed, const u64* index, const u64* step, int64_t since, int own, const uint8_t* bits, const float* reals, double* seconds) {
  if (copy) batch = pd_copy(batch);
  Batch& b = *(Batch*)batch;
  Clocks k{seed, index, step, (u64)since};
  int count = seconds ? 1 : std::max(1, std::min(threads, (int)b.groups.size()));
  std::atomic<int> next{0};
  auto task = [&](int) {
    Context* c = borrow(*b.program, b.g);
    c->seconds = seconds;
    for (int n; (n = next++) < (int)b.groups.size();)
      if (!b.rests(n)) run_group(*c, b, n, steps, k, Parameters{own != 0, bits, reals});
    put_back(c);
  };
  on_threads(count, task);
  return batch;
}
// The functions that separate libraries of passes call: see pd_program.
API void* const* pd_shared() {
#define EACH(result, name, ...) (void*)name,
  static void* const functions[] = {SHARED(EACH)};
#undef EACH
  return functions;
}
