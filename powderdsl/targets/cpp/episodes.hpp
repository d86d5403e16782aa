// Episodes of a task: one call acts, runs the worlds, measures, rewards, ends, begins the next episodes and writes
// observations. All arrays are the caller's, with a row for each world; see targets/cpp/episodes.py. Comes after the views.

// Copies a world of one batch over a world of another of the same size.
struct Line {
  int group, lane, row;
};
static Line line_of(const Batch& b, int world, int y) {
  const int lane = world * b.g.strips + y / b.g.height;
  return Line{lane / LANES, lane % LANES, y % b.g.height};
}
static void copy_world(Batch& to, int at, const Batch& from, int source) {
  const int rows = to.g.world_height(), words = to.g.words;
  Group& changed = to.groups[line_of(to, at, 0).group];
  const Group& given = from.groups[line_of(from, source, 0).group];
  changed.present = ~0ull;
  for (int i = 0; i < to.program->slots; i++) {
    Plane* p = changed.slot[i];
    const Plane* q = given.slot[i];
    if (p->zero && q->zero) continue;
    if (p->zero) memset(p->data, 0, sizeof(V) * to.g.cells());
    p->zero = false;
    p->around = p->beyond = 0;
    for (int y = 0; y < rows; y++) {
      const Line a = line_of(to, at, y), b = line_of(from, source, y);
      for (int w = 0; w < words; w++)
        ((Word*)p->data)[((size_t)a.row * words + w) * LANES + a.lane] = (Word)word_of(q, b.lane, b.row * words + w);
    }
  }
  for (int i = 0; i < to.program->reals; i++) {
    Field* f = changed.real[i];
    const Field* h = given.real[i];
    for (int y = 0; y < rows; y++) {
      const Line a = line_of(to, at, y), b = line_of(from, source, y);
      const size_t r = (size_t)a.lane * to.g.height + a.row, s = (size_t)b.lane * from.g.height + b.row;
      f->live[r] = h->live[s];
      if (!f->live[r]) continue;
      f->still = false;
      copy_floats(to.g, f->data + r * to.g.stride + HALO, h->data + s * from.g.stride + HALO);
    }
  }
}
// The worlds `places` of a batch become the worlds `sources` of another; null: 0, 1, ….
API void pd_take(void* to, const int64_t* places, const void* from, const int64_t* sources, int count) {
  for (int k = 0; k < count; k++) copy_world(*(Batch*)to, places ? places[k] : k, *(const Batch*)from, sources ? sources[k] : k);
}

struct Op {
  int64_t op, number;
  double value;
};
struct Formula {
  int64_t count;  // 0: there is none
  const Op* op;
};
struct Fresh {  // what a placed element sets in a slot: int64 or, without bits, float32 [choices]
  int64_t slot, bits;
  const void* values;
};
enum { BLOW = -1 };
enum { SAME_STEP, NEXT_STEP, DISABLED };
struct Play {
  // The task.
  int64_t threads, steps, free_steps, actions, limit, mode, last_terminates, counts_always;
  // Actions: `numbers` of each, below `most`, are those of `column` among the five, or with `table` the row of a table.
  int64_t numbers;
  const int64_t *most, *column, *table, *edges[2], *choices;
  int64_t fresh_count, counts_painted, element, element_bits, speed_slots[2];
  const Fresh* fresh;
  double speed;
  // Worlds.
  void* batch;
  u64 *seed, *index, *step;
  int64_t own_params;  // whether each world has its own
  const uint8_t* param_bits;
  const float* param_reals;
  // Episodes.
  int64_t *world, *acted, *episode;
  uint8_t *failed, *waiting;
  double *start, *before, *now, *returned;
  // Measures.
  const Counts* counts;
  u64* masks;
  double* sizes;
  int64_t measures, mask_words, own_masks;  // whether each world has its own
  Formula each, final, success, failure;
  // Start worlds: episode e of world i lies at i * depth + e % depth; `filled` is the first that is not there. Or the next
  // one of world i at `entry`, unless null. Or `start_worlds`, if there are any: the first ones of a split, which episodes
  // draw from as `world_seeds` does.
  const void* pool;
  int64_t depth, start_worlds;
  int64_t* base;
  const int64_t *entry, *pool_world, *filled;
  const double *pool_start, *pool_sizes;
  const u64* pool_masks;
  // Observations, of `size` bytes.
  int64_t views, size;
  const View* view;
  // Actions and results: those of world i are at `places`, −1 if its cells do not matter; null: at i. `rows` results: see
  // `Results`. `last_observed` has room for all worlds.
  const int64_t* places;
  int64_t rows;
  uint8_t *observed, *last_observed, *results;
  int64_t place_of(int64_t i) const { return places ? places[i] : i; }
  // Kept between the parts of a step.
  int64_t* action;  // [worlds][5]: taken, left, painted, placed, blown
  uint8_t* begins;  // whether the next episode begins
  int64_t counted, ended;  // whether cells were counted; how many episodes ended in the last step
};
struct Results {  // one after another in memory
  int64_t *episode_length, *shown, *last_shown;
  float *reward, *episode_return;
  uint8_t *terminated, *truncated, *succeeded, *ended, *active, *everyone;
  Results(uint8_t* at, size_t n) {
    episode_length = (int64_t*)at, shown = episode_length + n, last_shown = shown + n;
    reward = (float*)(last_shown + n), episode_return = reward + n;
    terminated = (uint8_t*)(episode_return + n), truncated = terminated + n, succeeded = truncated + n, ended = succeeded + n;
    active = ended + n, everyone = active + n;
  }
};
enum { TAKEN, LEFT, PAINTED, PLACED, BLOWN, ACTION_NUMBERS };

// Counts the cells of boxes that hold another element than the chosen one.
static void count_painted(const Play& p, Batch& b, const int64_t* boxes, const int64_t* chosen) {
  const Fresh* fresh = std::find_if(p.fresh, p.fresh + p.fresh_count, [&](const Fresh& f) { return f.bits && f.slot == p.element; });
  const int64_t* ids = (const int64_t*)fresh->values;
  in_boxes(b, boxes, [&](Group& group, int lane, int world, int first, int last, const int64_t* box) {
    for (int w = 0; w < b.g.words; w++) {
      const int from = (int)std::max<int64_t>(box[2] - BITS * w, 0), to = (int)std::min<int64_t>(box[3] - BITS * w, BITS);
      for (int y = first; from < to && y < last; y++) {
        Word differs = 0;
        for (int i = 0; i < p.element_bits; i++)
          differs |= (Word)word_of(group.slot[p.element + i], lane, y * b.g.words + w) ^ (ids[chosen[world]] >> i & 1 ? FULL : 0);
        p.action[world * ACTION_NUMBERS + PAINTED] += __builtin_popcountll((Word)(differs & (FULL >> (BITS - (to - from)) << from)));
      }
    }
  });
}
// Fills boxes with new cells of the chosen elements.
template <class P> static void place(const P& p, Batch& b, const int64_t* boxes, const int64_t* chosen) {
  std::vector<int64_t> values(b.worlds);
  std::vector<float> reals(b.worlds);
  for (int k = 0; k < p.fresh_count; k++) {
    const Fresh& fresh = p.fresh[k];
    for (int i = 0; i < b.worlds; i++)
      if (fresh.bits) values[i] = ((const int64_t*)fresh.values)[chosen[i]];
      else reals[i] = ((const float*)fresh.values)[chosen[i]];
    if (fresh.bits) fill_values(b, fresh.slot, fresh.bits, boxes, values.data());
    else fill_reals(b, fresh.slot, boxes, reals.data());
  }
}
static void act(Play& p, Batch& b, const int64_t* actions) {
  const int worlds = b.worlds;
  std::vector<int64_t> placed(4 * worlds), blown(4 * worlds), chosen(worlds);
  std::vector<float> speeds[2] = {std::vector<float>(worlds), std::vector<float>(worlds)};
  bool places = false, blows = false;
  for (int i = 0; i < worlds; i++) {
    if (b.is_idle(i)) continue;
    int64_t five[5] = {0, 0, 0, 1, 1};
    const int64_t* given = actions + p.place_of(i) * p.numbers;
    if (p.table) memcpy(five, p.table + 5 * given[0], sizeof five);
    else for (int k = 0; k < p.numbers; k++) five[p.column[k]] = given[k];
    const int64_t choice = p.choices[five[2]];
    int64_t* done = p.action + i * ACTION_NUMBERS;
    done[PAINTED] = 0, done[PLACED] = choice >= 0, done[BLOWN] = choice == BLOW;
    chosen[i] = five[2];
    for (int axis = 0; axis < 2; axis++) speeds[axis][i] = (float)(p.speed * (double)(five[4 - axis] - 1));
    if (choice < BLOW || p.waiting[i]) continue;
    (choice < 0 ? blows : places) = true;
    int64_t* box = (choice < 0 ? blown : placed).data() + 4 * i;
    for (int axis = 0; axis < 2; axis++)
      for (int end = 0; end < 2; end++) box[2 * axis + end] = p.edges[axis][2 * five[1 - axis] + end];
  }
  if (places && p.counts_painted) count_painted(p, b, placed.data(), chosen.data());
  if (places) place(p, b, placed.data(), chosen.data());
  for (int axis = 0; blows && axis < 2; axis++)
    if (p.speed_slots[axis] >= 0) fill_reals(b, p.speed_slots[axis], blown.data(), speeds[axis].data());
}
// Steps of some worlds, in ascending order, with the clocks and parameters of `p`.
template <class P> static void run_some(P& p, Batch& b, const std::vector<int>& places, int64_t steps) {
  const size_t count = places.size(), worlds = b.worlds, bits_each = b.program->param_planes, reals_each = b.program->param_reals;
  if (count + std::count(b.idle.begin(), b.idle.end(), 1) == worlds) {  // all that are not idle
    pd_run(&b, 0, steps, p.threads, p.seed, p.index, p.step, 0, p.own_params, p.param_bits, p.param_reals, nullptr);
    for (int i : places) p.step[i] += steps;
    return;
  }
  Batch* part = (Batch*)pd_new(b.program, count, b.g.world_height(), b.g.width, 0);
  std::vector<u64> seed(count), index(count), step(count);
  std::vector<uint8_t> bits(count * bits_each + 1);
  std::vector<float> reals(count * reals_each + 1);
  for (size_t k = 0; k < count; k++) {
    const int i = places[k];
    copy_world(*part, k, b, i);
    seed[k] = p.seed[i], index[k] = p.index[i], step[k] = p.step[i];
    const size_t from = p.own_params ? i : 0;
    std::copy_n(p.param_bits + from * bits_each, bits_each, &bits[k * bits_each]);
    std::copy_n(p.param_reals + from * reals_each, reals_each, &reals[k * reals_each]);
  }
  pd_run(part, 0, steps, p.threads, seed.data(), index.data(), step.data(), 0, 1, bits.data(), reals.data(), nullptr);
  for (size_t k = 0; k < count; k++) copy_world(b, places[k], *part, k), p.step[places[k]] += steps;
  pd_free(part);
}
// The first part of a step. Returns -1; or the place of the first number that is out of range, and nothing has changed.
API int64_t pd_act(Play* play, const int64_t* actions) {
  Play& p = *play;
  Batch& b = *(Batch*)p.batch;
  for (int i = 0; i < b.worlds; i++)
    for (int64_t k = 0; k < p.numbers && !b.is_idle(i); k++)
      if (const int64_t at = p.place_of(i) * p.numbers + k; (u64)actions[at] >= (u64)p.most[k]) return at;
  act(p, b, actions);
  pd_run(&b, 0, p.steps, p.threads, p.seed, p.index, p.step, 0, p.own_params, p.param_bits, p.param_reals, nullptr);
  std::vector<int> last;
  bool any_last = false;
  for (int i = 0; i < b.worlds; i++) {
    if (b.is_idle(i)) continue;
    p.step[i] += p.steps, p.acted[i]++;
    p.action[i * ACTION_NUMBERS + TAKEN] = p.acted[i], p.action[i * ACTION_NUMBERS + LEFT] = p.actions - p.acted[i];
    any_last |= p.acted[i] >= p.actions;
    if (p.acted[i] >= p.actions && !(p.waiting[i] && p.mode == NEXT_STEP)) last.push_back(i);
  }
  if (p.free_steps && !last.empty()) run_some(p, b, last, p.free_steps);
  p.counted = p.counts_always || any_last;
  if (p.counted && p.counts) count_cells(b, *p.counts, p.masks, p.own_masks ? p.mask_words : 0, p.sizes, p.own_masks ? p.measures : 0, p.now);
  return -1;
}

// The value of an expression: operations on a stack, in the order of OPS in targets/cpp/episodes.py.
static double value_of(const Play& p, const Formula& formula, int world, double* stack) {
  double* top = stack - 1;
  const double nan = std::numeric_limits<double>::quiet_NaN();
  for (int64_t i = 0; i < formula.count; i++) {
    const Op& op = formula.op[i];
    const int64_t at = world * p.measures + op.number;
    if (op.op <= 4) {
      switch (op.op) {
        case 0: *++top = op.value; break;
        case 1: *++top = p.now[at]; break;
        case 2: *++top = p.start[at]; break;
        case 3: *++top = p.before[at]; break;
        default: *++top = (double)p.action[world * ACTION_NUMBERS + op.number];
      }
      continue;
    }
    if (op.op <= 7) {
      double& a = *top;
      a = op.op == 5 ? -a : op.op == 6 ? fabs(a) : 1 - a;
      continue;
    }
    if (op.op == 8) {  // condition, yes, no
      top -= 2;
      top[0] = top[0] != 0 ? top[1] : top[2];
      continue;
    }
    const double b = *top--;
    double& a = *top;
    switch (op.op) {
      case 9: a = a + b; break;
      case 10: a = a - b; break;
      case 11: case 12: a = a * b; break;
      case 13: a = b == 0 ? 0 : a / b; break;
      case 14: a = b == 0 ? 0 : floor(a / b); break;
      case 15: {
        const double rest = b == 0 ? 0 : fmod(a, b);
        a = rest != 0 && (rest < 0) != (b < 0) ? rest + b : rest;
        break;
      }
      case 16: a = a != a || b != b ? nan : std::min(a, b); break;
      case 17: case 18: a = a != a || b != b ? nan : std::max(a, b); break;
      case 19: a = a < b; break;
      case 20: a = a <= b; break;
      default: a = a == b;
    }
  }
  return *top;
}
static void observe(const Play& p, const Batch& b, int first, int last) {
  if (!p.places) return show(b, lanes_of(b, first, last), p.view, p.views, p.observed, p.size);
  for (int i = first; i < last; i++)
    if (!b.is_idle(i)) show(b, lanes_of(b, i, i + 1), p.view, p.views, p.observed + (p.places[i] - i) * p.size, p.size);
}
static int64_t drawn_world(const Play& p, int i) {  // as world_seeds of envs/tensor_env.py
  const u64 base = p.base[i];
  const u32 episode = (u32)p.episode[i], key = mix(mix((u32)base) ^ (u32)(base >> 32));
  const u64 high = mix(key + episode), low = mix(key ^ mix(episode));
  return (p.episode[i] == 0 ? base : high << 31 | low >> 1) % (u64)p.start_worlds;
}
static void begin(Play& p, Batch& b, int i) {
  const int64_t episode = ++p.episode[i], n = p.measures;
  const int64_t at = p.start_worlds ? drawn_world(p, i) : p.entry ? p.entry[i] : i * p.depth + episode % p.depth;
  copy_world(b, i, *(const Batch*)p.pool, at);
  p.world[i] = p.seed[i] = p.start_worlds ? at : p.pool_world[at];
  p.index[i] = p.step[i] = p.acted[i] = p.failed[i] = p.waiting[i] = 0;
  p.returned[i] = 0;
  std::copy_n(p.pool_start + at * n, n, p.start + i * n);
  std::copy_n(p.pool_start + at * n, n, p.before + i * n);
  if (!p.own_masks) return;
  std::copy_n(p.pool_masks + at * p.mask_words, p.mask_words, p.masks + i * p.mask_words);
  std::copy_n(p.pool_sizes + at * n, n, p.sizes + i * n);
}
// The second part. Returns whether all next episodes that begin are in the pool.
API int pd_finish(Play* play) {
  Play& p = *play;
  const Batch& b = *(Batch*)p.batch;
  const int worlds = b.worlds;
  const size_t values = worlds * p.measures;
  const Results r(p.results, p.rows);
  if (!p.counted) std::copy_n(p.before, values, p.now);
  std::vector<double> stack(std::max({p.each.count, p.final.count, p.success.count, p.failure.count}) + 1);
  bool ready = true;
  p.ended = 0;
  for (int i = 0; i < worlds; i++) {
    if (b.is_idle(i)) continue;
    auto value = [&](const Formula& formula) { return formula.count ? value_of(p, formula, i, stack.data()) : 0.0; };
    const bool waits = p.mode == NEXT_STEP && p.waiting[i], last = p.acted[i] >= p.actions;
    bool success = value(p.success) != 0;
    p.failed[i] = value(p.failure) != 0;
    double reward = value(p.each);
    if (p.final.count) reward = reward + (last || success || p.failed[i] ? value(p.final) : 0.0);
    bool terminated = success || p.failed[i] || (p.last_terminates && last);
    bool truncated = (last || p.acted[i] >= p.limit) && !terminated;
    if (waits) reward = 0, success = terminated = truncated = false;
    const bool ended = terminated || truncated;
    p.ended += ended;
    const int64_t at = p.place_of(i);
    r.reward[at] = (float)reward;
    p.returned[i] += (double)r.reward[at];
    r.terminated[at] = terminated, r.truncated[at] = truncated, r.succeeded[at] = success, r.ended[at] = ended;
    r.active[at] = !waits, r.everyone[at] = true;  // each time, since callers may change them
    r.episode_return[at] = (float)(p.returned[i] * ended);
    r.episode_length[at] = p.acted[i] * ended;
    r.last_shown[at] = p.world[i];
    p.begins[i] = p.mode == NEXT_STEP ? waits : p.mode == SAME_STEP && ended;
    if (p.mode != SAME_STEP) p.waiting[i] = ended;
    ready &= !p.begins[i] || p.start_worlds || p.episode[i] + 1 < p.filled[i];
  }
  std::copy_n(p.now, values, p.before);
  return ready;
}
// The last part: begins episodes where `begins` says so, and observes.
API void pd_begin(Play* play) {
  Play& p = *play;
  Batch& b = *(Batch*)p.batch;
  const Results r(p.results, p.rows);
  b.idle.resize(p.places ? b.worlds : 0);
  uint8_t* last = p.mode == SAME_STEP ? p.last_observed : nullptr;
  if (last) observe(p, b, 0, b.worlds);
  for (int i = 0; i < b.worlds; i++) {
    if (p.places && (b.idle[i] = p.places[i] < 0)) continue;
    if (p.begins[i]) {
      if (last) memcpy(last, p.observed + i * p.size, p.size), last += p.size;
      begin(p, b, i);
      if (last) observe(p, b, i, i + 1);
    }
    r.shown[p.place_of(i)] = p.world[i];
  }
  if (!last) observe(p, b, 0, b.worlds);
}
// A step in one call; without actions, only pd_begin. Returns what pd_act does; or -2 if the pool has to be filled before
// pd_begin.
API int64_t pd_play(Play* play, const int64_t* actions) {
  if (actions) {
    const int64_t wrong = pd_act(play, actions);
    if (wrong >= 0) return wrong;
    if (!pd_finish(play)) return -2;
  }
  pd_begin(play);
  return -1;
}
// Steps of the episodes of several libraries on some threads, with shared results; `functions`: pd_play of each library.
using PlayFunction = int64_t(Play*, const int64_t*);
API void pd_play_all(int64_t count, PlayFunction* const* functions, Play* const* plays, const int64_t* actions, uint8_t* results, uint8_t* observed, int threads) {
  std::atomic<int64_t> next{0};
  on_threads((int)std::min<int64_t>(threads, count), [&](int) {
    for (int64_t n; (n = next++) < count;) {
      plays[n]->results = results, plays[n]->observed = observed;
      functions[n](plays[n], actions);
    }
  });
}
