// A task's environment behind the functions of its C header. Comes after the episodes and the generated task: ROWS, COLUMNS,
// WORLDS start worlds, `PIECES` of their state, `POOL` values, and `describe`, which fills in what does not depend on worlds.

struct powder_env {
  Play play{};
  std::vector<u64> seed, index, step, masks;
  std::vector<int64_t> world, acted, episode, base, action;
  std::vector<uint8_t> failed, waiting, begins, results;
  std::vector<double> start, before, now, returned, sizes;
};

// Values of the start worlds: of element ids by a table [256], or in runs of a count and a value.
template <class T> static void load_piece(void* batch, const PieceData& piece, const std::vector<uint8_t>& ids) {
  std::vector<T> cells(ids.size());
  size_t at = 0;
  for (const u32* run = piece.runs; run && at < cells.size(); run += 2)
    for (u32 i = 0; i < run[0]; i++, at++) memcpy(&cells[at], run + 1, sizeof(T));
  for (size_t i = 0; piece.table && i < cells.size(); i++) memcpy(&cells[i], piece.table + ids[i], sizeof(T));
  pd_load(batch, piece.slot, piece.bits, sizeof(T), cells.data(), ROWS * COLUMNS);
}
static const void* start_worlds() {  // made once, and shared
  static const void* pool = [] {
    void* batch = pd_new(&PROGRAM, WORLDS, ROWS, COLUMNS, 0);
    std::vector<uint8_t> ids;
    for (const u32* run = PIECES[0].runs; ids.size() < (size_t)WORLDS * ROWS * COLUMNS; run += 2) ids.insert(ids.end(), run[0], (uint8_t)run[1]);
    for (const PieceData& piece : PIECES) {
      if (piece.item == 1) load_piece<uint8_t>(batch, piece, ids);
      else if (piece.item == 2) load_piece<uint16_t>(batch, piece, ids);
      else load_piece<u32>(batch, piece, ids);
    }
    return batch;
  }();
  return pool;
}

API powder_env* powder_new(int worlds) {
  if (worlds < 1) return nullptr;
  powder_env* env = new powder_env();
  Play& p = env->play;
  describe(p);
  p.pool = start_worlds(), p.start_worlds = WORLDS;
  p.rows = worlds;
  p.batch = pd_new(&PROGRAM, worlds, ROWS, COLUMNS, 0);
  auto rows = [&](auto& vector, auto*& pointer, size_t size) { vector.resize(worlds * size), pointer = vector.data(); };
  rows(env->seed, p.seed, 1), rows(env->index, p.index, 1), rows(env->step, p.step, 1);
  rows(env->world, p.world, 1), rows(env->acted, p.acted, 1), rows(env->episode, p.episode, 1), rows(env->base, p.base, 1);
  rows(env->action, p.action, ACTION_NUMBERS), rows(env->failed, p.failed, 1), rows(env->waiting, p.waiting, 1);
  rows(env->begins, p.begins, 1), rows(env->results, p.results, 38), rows(env->returned, p.returned, 1);
  rows(env->start, p.start, p.measures), rows(env->before, p.before, p.measures), rows(env->now, p.now, p.measures);
  env->masks.assign(p.pool_masks, p.pool_masks + p.mask_words), env->sizes.assign(p.pool_sizes, p.pool_sizes + p.measures);
  if (p.own_masks) rows(env->masks, p.masks, p.mask_words), rows(env->sizes, p.sizes, p.measures);
  p.masks = env->masks.data(), p.sizes = env->sizes.data();
  p.param_bits = PARAMETER_BITS, p.param_reals = PARAMETER_VALUES;
  return env;
}
API void powder_free(powder_env* env) {
  pd_free(env->play.batch);
  delete env;
}
API void powder_reset(powder_env* env, uint64_t seed, uint8_t* observed) {
  Play& p = env->play;
  for (size_t i = 0; i < env->base.size(); i++) p.base[i] = (int64_t)(seed + i), p.episode[i] = -1, p.begins[i] = 1;
  p.observed = observed;
  pd_begin(&p);
}
API int64_t powder_step(powder_env* env, const int64_t* actions, uint8_t* observed, float* rewards, uint8_t* terminated, uint8_t* truncated) {
  Play& p = env->play;
  const size_t worlds = env->base.size();
  p.observed = observed;
  const int64_t status = pd_play(&p, actions);
  if (status >= 0) return status;
  const Results r(p.results, worlds);
  std::copy_n(r.reward, worlds, rewards);
  std::copy_n(r.terminated, worlds, terminated), std::copy_n(r.truncated, worlds, truncated);
  return -1;
}
