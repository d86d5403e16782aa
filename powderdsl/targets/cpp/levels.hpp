// Episodes of OGBench's levels. One call takes a choice in each episode. After the third choice of an action, the world runs a
// step and a block is painted. Arrays are the caller's, with a row for each world; see targets/cpp/episodes.py. Comes after the
// episodes.

struct LevelPlay {
  int64_t threads, elements, places;  // how many can be chosen
  const int64_t* edges[2];            // first row of the block at each y, and the one after its last; then columns
  int64_t fresh_count, element, element_bits;
  const Fresh* fresh;
  int64_t views, size, line;  // bytes of a picture and of one of its rows
  const View* view;
  const uint8_t *colors, *lit;  // a row of the action frame: by element, and by x; the first of each if not chosen yet
  int64_t name;                 // the hash of what invalid choices are drawn for
  // Worlds.
  void* batch;
  u64 *seed, *index, *step;
  int64_t own_params;
  const uint8_t* param_bits;
  const float* param_reals;
  // Episodes. `goals`: null if there are none.
  int64_t *stage, *elapsed, *chosen, *errors;
  const uint8_t* goals;
  uint8_t* pictures;
};
static int64_t drawn_choice(const LevelPlay& p, int i, int64_t count) {  // as `keyed` of ogbench/episodes.py
  u32 keys[2];
  for (int half = 0; half < 2; half++)
    keys[half] = mix(mix(world_key(p.seed[i], p.index[i], half) + (u32)p.elapsed[i]) + (u32)p.name);
  return (int64_t)((double)mix(mix(keys[0] ^ mix(keys[1]))) / 4294967296.0 * (double)count);
}
// Number of cells of a goal, [row][column], whose number is neither there in a world nor in one of the four cells beside it,
// around edges.
static int64_t missed_in(const Batch& b, int world, int slot, int bits, const uint8_t* goal) {
  const int height = b.g.world_height(), width = b.g.width, apart = width + 2;
  constexpr u64 LOW = 0x7f7f7f7f7f7f7f7f;
  std::vector<uint8_t> cells((size_t)height * width), wide((size_t)(height + 2) * apart + 8);
  store_values(b, lanes_of(b, world, world + 1), slot, bits, 0, cells.data(), 0);
  for (int y = -1; y <= height; y++) {
    const uint8_t* from = cells.data() + (size_t)((y + height) % height) * width;
    uint8_t* row = wide.data() + (size_t)(y + 1) * apart;
    row[0] = from[width - 1], row[width + 1] = from[0];
    memcpy(row + 1, from, width);
  }
  int64_t sum = 0;
  const uint8_t* cell = wide.data() + apart + 1;
  for (int y = 0; y < height; y++, cell += apart)
    for (int x = 0; x < width; x += 8) {  // eight cells in a word
      const int count = std::min(8, width - x);
      u64 wanted = 0, missed = ~LOW;
      if (count == 8) memcpy(&wanted, goal, 8);
      else memcpy(&wanted, goal, count), missed >>= 8 * (8 - count);
      const int places[] = {0, -1, 1, -apart, apart};
#pragma GCC unroll 5
      for (int k = 0; k < 5; k++) {
        u64 there;
        memcpy(&there, cell + x + places[k], 8);
        missed &= (((there ^ wanted) & LOW) + LOW) | (there ^ wanted);  // the high bit of each byte that differs
      }
      sum += __builtin_popcountll(missed), goal += count;
    }
  return sum;
}
// Takes a choice in the episodes that are `active`. Choices out of range are replaced.
API void pd_choose(LevelPlay* level, const int64_t* actions, const uint8_t* active) {
  LevelPlay& p = *level;
  Batch& b = *(Batch*)p.batch;
  std::vector<int> painted;
  std::vector<int64_t> boxes(4 * b.worlds), elements(b.worlds);
  for (int i = 0; i < b.worlds; i++) {
    if (!active[i]) continue;
    int64_t &stage = p.stage[i], *chosen = p.chosen + 3 * i;
    const int64_t count = stage == 0 ? p.elements : p.places;
    chosen[stage] = (u64)actions[i] < (u64)count ? actions[i] : drawn_choice(p, i, count);
    p.elapsed[i]++;
    stage = (stage + 1) % 3;
    if (stage > 0) continue;
    painted.push_back(i);
    elements[i] = chosen[0];
    for (int axis = 0; axis < 2; axis++) std::copy_n(p.edges[axis] + 2 * chosen[2 - axis], 2, &boxes[4 * i + 2 * axis]);
  }
  if (painted.empty()) return;
  run_some(p, b, painted, 1);
  place(p, b, boxes.data(), elements.data());
  const int64_t cells = (int64_t)b.g.world_height() * b.g.width;
  for (int i : painted) {
    show(b, lanes_of(b, i, i + 1), p.view, p.views, p.pictures, p.size);
    if (p.goals) p.errors[i] = missed_in(b, i, p.element, p.element_bits, p.goals + i * cells);
  }
}
// A picture, each of whose rows is combined with the same row.
static void lay_over(const uint8_t* picture, const uint8_t* row, int64_t line, int64_t size, uint8_t* out) {
  typedef uint8_t Part __attribute__((vector_size(32), aligned(1), may_alias));
  for (const uint8_t* end = picture + size; picture < end; picture += line, out += line) {
    int64_t x = 0;
    for (; x + 32 <= line; x += 32) *(Part*)(out + x) = *(const Part*)(picture + x) | *(const Part*)(row + x);
    for (; x < line; x++) out[x] = picture[x] | row[x];
  }
}
// Observations: pictures, with the action frame in each row.
API void pd_observe(const LevelPlay* level, uint8_t* observed, int worlds) {
  const LevelPlay& p = *level;
  std::vector<uint8_t> frame(p.line);
  for (int i = 0; i < worlds; i++) {
    const uint8_t* color = p.colors + (p.stage[i] > 0 ? p.chosen[3 * i] + 1 : 0) * p.line;
    const uint8_t* lit = p.lit + (p.stage[i] > 1 ? p.chosen[3 * i + 1] + 1 : 0) * p.line;
    std::transform(color, color + p.line, lit, frame.begin(), std::bit_and<uint8_t>());
    lay_over(p.pictures + i * p.size, frame.data(), p.line, p.size, observed + i * p.size);
  }
}
