// Memory of planes and fields, which batches and contexts pass on. Comes after planes.hpp.
#include <atomic>
#include <cmath>
#include <functional>
#include <limits>
#include <map>
#if !defined(__wasm__)
#include <condition_variable>
#include <mutex>
#include <thread>
typedef std::mutex Mutex;
typedef std::lock_guard<std::mutex> Hold;
#else  // has one thread
struct Mutex {};
struct Hold {
  Hold(Mutex&) {}
};
#endif

template <class T> static T* aligned(size_t count) {
  size_t bytes = (count * sizeof(T) + 127) / 64 * 64;
  void* p = aligned_alloc(64, bytes);
  if (!p) abort();
  memset(p, 0, bytes);
  return (T*)p;
}
// Buffers of batches that are gone are used again: fresh memory from the system costs more than a step.
constexpr size_t SPARE_BYTES = 1 << 28;  // at most this much waits, of each kind
template <class T> struct Spare {
  Mutex lock;
  size_t bytes = 0;
  std::map<size_t, std::vector<T*>> waiting;  // by size
};
static Spare<Plane> spare_planes;
static Spare<Field> spare_fields;
static void release(Plane* p) { free(p->data); delete p; }
static void release(Field* f) { free(f->data); free(f->live); delete f; }
template <class T> static T* reuse(Spare<T>& spare, size_t size) {
  Hold hold(spare.lock);
  std::vector<T*>& waiting = spare.waiting[size];
  if (waiting.empty()) return nullptr;
  T* t = waiting.back();
  waiting.pop_back();
  spare.bytes -= size;
  return t;
}
template <class T> static void drop(Spare<T>& spare, T* t, size_t size) {
  Hold hold(spare.lock);
  for (auto& [other, waiting] : spare.waiting)  // other sizes may never be used again
    for (; other != size && !waiting.empty() && spare.bytes + size > SPARE_BYTES; waiting.pop_back()) {
      release(waiting.back());
      spare.bytes -= other;
    }
  if (spare.bytes + size > SPARE_BYTES) return release(t);
  spare.waiting[size].push_back(t);
  spare.bytes += size;
}
static size_t plane_size(const Grid& g) { return sizeof(V) * (g.cells() + g.halos()); }
static size_t field_floats(const Grid& g) { return (size_t)LANES * g.height * g.stride + HALO; }
static size_t field_size(const Grid& g) { return sizeof(float) * field_floats(g) + LANES * g.height; }
static Plane* new_plane(const Grid& g) {  // what it holds is not defined
  Plane* p = reuse(spare_planes, plane_size(g));
  return p ? p : new Plane{aligned<V>(g.cells() + g.halos()), 0, true, 0, 0};
}
static Field* new_field(const Grid& g) {
  Field* f = reuse(spare_fields, field_size(g));
  return f ? f : new Field{aligned<float>(field_floats(g) + CHUNK), aligned<uint8_t>(LANES * g.height), 0, true};
}
static void drop(const Grid& g, Plane* p) { drop(spare_planes, p, plane_size(g)); }
static void drop(const Grid& g, Field* f) { drop(spare_fields, f, field_size(g)); }

OUTLINE void put(Context& c, Plane* p) { c.planes.push_back(p); }
template <class T> ALWAYS T* taken(const Grid& g, std::vector<T*>& free, T* (*make)(const Grid&)) {
  T* t = free.empty() ? make(g) : free.back();
  if (!free.empty()) free.pop_back();
  t->refs = 1;
  return t;
}
OUTLINE Plane* take(Context& c) {
  Plane* p = taken(c.g, c.planes, new_plane);
  p->around = p->beyond = 0;
  return p;
}
OUTLINE Field* take_field(Context& c) { return taken(c.g, c.fields, new_field); }
// A plane of this owner alone, to be written over.
OUTLINE void own_plane(Context& c, Plane*& p) {
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
// A field of this owner alone, to be written over.
OUTLINE void own_field(Context& c, Field*& f) {
  if (f != c.calm && f->refs == 1) return;
  Field* copy = take_field(c);
  memcpy(copy->live, f->live, LANES * c.g.height);
  for (int line = 0; line < LANES * c.g.height && !f->still; line++)
    if (f->live[line]) copy_floats(c.g, row_of(c, *copy, line), row_of(c, *f, line));
  copy->still = f->still;
  give(c, f);
  f = copy;
}
