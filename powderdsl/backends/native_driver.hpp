// Batches of worlds, packing, threads and the entry points. Comes after the generated passes.
#include <unistd.h>

struct Group {
  Plane* slot[SLOTS + 1];
  Field* real[REALS + 1];
};
struct Batch {
  Grid g;
  int worlds;
  std::vector<Group> groups;
};

static Grid make_grid(int height, int width) {
  return Grid{height, width, (width + 63) / 64, (width + CHUNK - 1) / CHUNK * CHUNK + (2 * REACH <= HALO ? HALO : 2 * HALO)};
}
static bool fixed_flag(const FixedPlane& f, const Grid& g, int y, int x) {
  switch (f.kind) {
    case 0: return (y % f.a) >> f.b & 1;
    case 1: return (x % f.a) >> f.b & 1;
    default: return y + f.a >= 0 && y + f.a < g.height && x + f.b >= 0 && x + f.b < g.width;
  }
}
static Context* new_context(const Grid& g) {
  Context* c = new (std::align_val_t(64)) Context();
  c->g = g;
  int rest = g.width - 64 * (g.words - 1);
  c->valid_last = splat(rest == 64 ? ~0ull : (1ull << rest) - 1);
  for (int y = -HALO; y < g.height + HALO; y++) {
    c->lines.push_back(((y % g.height) + g.height) % g.height);
    c->wrapped.push_back(c->lines.back() * g.words);
  }
  for (int dx = -HALO; dx <= HALO; dx++) c->turn[dx + HALO] = ((dx % g.width) + g.width) % g.width;
  c->nothing = new Plane{aligned<V>(g.cells()), 1, true};
  c->everything = new Plane{aligned<V>(g.cells()), 1, false};
  for (int i = 0; i < g.cells(); i++) c->everything->data[i] = c->valid(i % g.words);
  c->calm = new Field{nullptr, aligned<uint8_t>(LANES * g.height), 1, true};
  c->nothing_row = aligned<V>(g.words);
  c->change = aligned<V>(2 * g.words);
  c->late = aligned<V>((MOVING + 1) * g.words);
  c->zeros = aligned<float>(g.stride + HALO + CHUNK);
  c->active = aligned<u64>((size_t)(ACTIVE + 1) * LANES * c->active_words());
  for (const FixedPlane& f : FIXED) {
    V* plane = aligned<V>(g.cells());
    for (int y = 0; y < g.height; y++)
      for (int x = 0; x < g.width; x++)
        if (fixed_flag(f, g, y, x)) plane[y * g.words + x / 64] |= splat(1ull << (x % 64));
    c->fixed.push_back(plane);
  }
  return c;
}
static void free_context(Context* c) {
  for (Plane* p : c->planes) drop(c->g, p);
  for (Field* f : c->fields) drop(c->g, f);
  release(c->nothing);
  release(c->everything);
  release(c->calm);
  free(c->nothing_row);
  free(c->change);
  free(c->late);
  free(c->zeros);
  free(c->active);
  for (V* p : c->fixed) free(p);
  c->~Context();
  operator delete(c, std::align_val_t(64));
}

// Contexts wait here between calls: at most a few, of the grids used last.
static std::mutex contexts_lock;
static std::vector<Context*> contexts;
static Context* borrow(const Grid& g) {
  std::lock_guard<std::mutex> hold(contexts_lock);
  for (size_t i = 0; i < contexts.size(); i++)
    if (contexts[i]->g.height == g.height && contexts[i]->g.width == g.width) {
      Context* c = contexts[i];
      contexts.erase(contexts.begin() + i);
      return c;
    }
  return new_context(g);
}
static void put_back(Context* c) {
  std::lock_guard<std::mutex> hold(contexts_lock);
  contexts.push_back(c);
  if (contexts.size() > 16) {
    free_context(contexts.front());
    contexts.erase(contexts.begin());
  }
}

static void own(Context& c, Field*& f) {
  if (f != c.calm && f->refs == 1) return;
  Field* copy = take_field(c);
  if (!f->still) memcpy(copy->data, f->data, field_size(c.g));
  memcpy(copy->live, f->live, LANES * c.g.height);
  copy->still = f->still;
  give(c, f);
  f = copy;
}
static void reset_slots(Context& c) {
  for (const ResetPlane& r : RESET_PLANES) {
    give(c, c.slot[r.slot]);
    c.slot[r.slot] = keep(r.value ? c.everything : c.nothing);
  }
  for (const ResetReal& r : RESET_REALS) {
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
};
static void begin_step(Context& c, const Clocks& k, int first, long done) {
  for (int s = 0; s < STREAMS; s++)
    for (int l = 0; l < LANES; l++) {
      int world = first + std::min(l, c.lanes - 1);
      u64 step = k.step[world] + done;
      u32 a = key(k.seed[world], k.index[world], step, STREAM_IDENT[s], 0x243F6A88u);
      u32 b = key(k.seed[world], k.index[world], step, STREAM_IDENT[s], 0x85A308D3u);
      c.k0[s][2 * l] = c.k0[s][2 * l + 1] = a;
      c.k1[s][2 * l] = c.k1[s][2 * l + 1] = b;
    }
  for (int i = 0; i < STEP_PLANES; i++)
    for (int l = 0; l < LANES; l++) {
      u64 step = k.step[first + std::min(l, c.lanes - 1)] + done;
      c.step_bits[i][l] = (step % STEP_TABLE[i].a) >> STEP_TABLE[i].b & 1 ? ~0ull : 0;
    }
}
static void run_group(Context& c, Batch& b, int number, long steps, const Clocks& k, const uint8_t* planes, const float* reals) {
  int first = number * LANES;
  c.lanes = std::min(LANES, b.worlds - first);
  for (int l = 0; l < LANES; l++) {
    int world = first + std::min(l, c.lanes - 1);
    for (int i = 0; i < PARAM_PLANES; i++) c.param_bits[i][l] = planes[(size_t)i * b.worlds + world] ? ~0ull : 0;
    for (int i = 0; i < PARAM_REALS; i++) c.param_real[i][l] = reals[(size_t)i * b.worlds + world];
  }
  Group& group = b.groups[number];
  for (int i = 0; i < SLOTS; i++) {
    c.slot[i] = group.slot[i];
    if (c.slot[i]->zero) {  // an empty plane of a batch may hold anything
      give(c, c.slot[i]);
      c.slot[i] = keep(c.nothing);
    }
  }
  for (int i = 0; i < REALS; i++) c.real[i] = group.real[i];
  for (long s = 0; s < steps; s++) {
    begin_step(c, k, first, s);
    reset_slots(c);
    run_passes(c);
  }
  for (int i = 0; i < SLOTS; i++) own(c, c.slot[i]), group.slot[i] = c.slot[i];
  for (int i = 0; i < REALS; i++) own(c, c.real[i]), group.real[i] = c.real[i];
}

// Threads that wait for work; the caller is one of them.
struct Pool {
  std::mutex lock;
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
      std::lock_guard<std::mutex> hold(lock);
      if (--running == 0) done.notify_one();
    }
  }
  void run(int count, std::function<void(int)> task) {
    {
      std::lock_guard<std::mutex> hold(lock);
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
static std::mutex pool_use;
static Pool& pool() {  // never destroyed: its threads may outlive main
  static Pool* p = new Pool();
  static pid_t owner = getpid();
  if (getpid() != owner) p = new Pool(), owner = getpid();  // a fork has none of its parent's threads
  return *p;
}

template <class T> static void load_values(Batch& b, int slot, int bits, const T* data) {
  const Grid& g = b.g;
  for (size_t n = 0; n < b.groups.size(); n++)
    for (int i = 0; i < bits; i++) {
      Plane* p = b.groups[n].slot[slot + i];
      memset(p->data, 0, sizeof(V) * g.cells());
      bool some = false;
      for (int l = 0; l < std::min(LANES, b.worlds - (int)n * LANES); l++) {
        const T* cell = data + ((size_t)n * LANES + l) * g.height * g.width;
        u64* out = (u64*)p->data;
        for (int y = 0; y < g.height; y++)
          for (int w = 0; w < g.words; w++) {
            int count = std::min(64, g.width - 64 * w);
            u64 word = 0;
            for (int x = 0; x < count; x++) word |= (u64)((u64)cell[x] >> i & 1) << x;
            cell += count;
            some |= word != 0;
            out[(y * g.words + w) * LANES + l] = word;
          }
      }
      p->zero = !some;
    }
}

#define API extern "C" __attribute__((visibility("default")))
API void* pd_new(int worlds, int height, int width) {
  Batch* b = new Batch{make_grid(height, width), worlds, std::vector<Group>((worlds + LANES - 1) / LANES)};
  for (Group& group : b->groups) {
    for (int i = 0; i < SLOTS; i++) group.slot[i] = new_plane(b->g), group.slot[i]->refs = 1, group.slot[i]->zero = true;
    for (int i = 0; i < REALS; i++) group.real[i] = new_field(b->g), group.real[i]->refs = 1;
  }
  return b;
}
API void pd_free(void* batch) {
  Batch* b = (Batch*)batch;
  for (Group& group : b->groups) {
    for (int i = 0; i < SLOTS; i++) drop(b->g, group.slot[i]);
    for (int i = 0; i < REALS; i++) drop(b->g, group.real[i]);
  }
  delete b;
}
API void* pd_copy(const void* batch) {
  const Batch* a = (const Batch*)batch;
  Batch* b = (Batch*)pd_new(a->worlds, a->g.height, a->g.width);
  for (size_t n = 0; n < a->groups.size(); n++) {
    for (int i = 0; i < SLOTS; i++) {
      const Plane* from = a->groups[n].slot[i];
      Plane* to = b->groups[n].slot[i];
      if (!from->zero) memcpy(to->data, from->data, sizeof(V) * a->g.cells());
      to->zero = from->zero;
    }
    for (int i = 0; i < REALS; i++) {
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
API void pd_load(void* batch, int slot, int bits, int item, const void* data) {
  Batch& b = *(Batch*)batch;
  if (item == 1) load_values(b, slot, bits, (const uint8_t*)data);
  else if (item == 2) load_values(b, slot, bits, (const int16_t*)data);
  else load_values(b, slot, bits, (const int32_t*)data);
}
API void pd_load_real(void* batch, int slot, const float* data, int64_t world_stride) {
  Batch& b = *(Batch*)batch;
  Context* c = borrow(b.g);
  for (Group& group : b.groups) {
    group.real[slot]->still = true;
    memset(group.real[slot]->live, 0, LANES * b.g.height);
  }
  for (int world = 0; world < b.worlds; world++) {
    Field* f = b.groups[world / LANES].real[slot];
    for (int y = 0; y < b.g.height; y++) {
      int r = world % LANES * b.g.height + y;
      float* row = f->data + (size_t)r * b.g.stride + HALO;
      memcpy(row, data + world * world_stride + (int64_t)y * b.g.width, sizeof(float) * b.g.width);
      f->live[r] = std::any_of(row, row + b.g.width, [](float v) { return v != 0; });
      if (f->live[r]) f->still = false;
      finish_row(*c, row);
    }
  }
  put_back(c);
}
API void pd_run(void* batch, int64_t steps, int threads, const u64* seed, const u64* index, const u64* step, const uint8_t* planes, const float* reals) {
  Batch& b = *(Batch*)batch;
  Clocks k{seed, index, step};
  int count = std::max(1, std::min(threads, (int)b.groups.size()));
  std::atomic<int> next{0};
  auto task = [&](int) {
    Context* c = borrow(b.g);
    for (int n; (n = next++) < (int)b.groups.size();) run_group(*c, b, n, steps, k, planes, reals);
    put_back(c);
  };
  if (count == 1) return task(0);
  std::lock_guard<std::mutex> hold(pool_use);
  pool().run(count, task);
}
#if defined(PROFILE)
API void pd_profile(double* seconds) {
  memcpy(seconds, pass_seconds, sizeof(double) * PASSES);
  memset(pass_seconds, 0, sizeof(pass_seconds));
}
#endif
