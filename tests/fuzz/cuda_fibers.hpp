// Comes after the generated kernel: runs its blocks, each by fibers in a given order.

template <class Need> static unsigned int busy_words(int base, Need need) {
  const int i = base + (fiber + 1) % THREADS;
  return i < BLOCK_WORDS && need(i);
}

static ucontext_t caller, fibers[THREADS];
static bool finished[THREADS], joined_flag, answer;
static const Worlds* given;

static bool any_fiber(bool flag) {  // to the caller, and on when all fibers have come here
  joined_flag = joined_flag || flag;
  swapcontext(&fibers[fiber], &caller);
  return answer;
}
static void run_fiber() {
  const int me = fiber;
  powderdsl_steps(*given);
  finished[me] = true;
  swapcontext(&fibers[me], &caller);
}
static void fill(u32* words, int count) {  // with what a GPU's memory may hold: anything
  for (int i = 0; i < count; i++) words[i] = i % 3 ? 2654435761u * (u32)i : 0;
}
// `order`: the fibers from first to last (0) or from last to first (1). Returns 1 if some waited where others had ended.
extern "C" __attribute__((visibility("default"))) int emulate(const Worlds* worlds, int blocks, int order) {
  constexpr size_t STACK = 1 << 20;
  char* stacks = (char*)malloc(STACK * THREADS);
  chip = (unsigned int*)malloc(sizeof(int) * (CHIP_WORDS + 1));
  given = worlds;
  int wrong = 0;
  for (block = 0; block < blocks; block++) {
    fill(chip, CHIP_WORDS);
    fill(worlds->scratch + (size_t)block * SCRATCH_WORDS, SCRATCH_WORDS);
    for (int f = 0; f < THREADS; f++) {
      finished[f] = false;
      getcontext(&fibers[f]);
      fibers[f].uc_stack.ss_sp = stacks + f * STACK;
      fibers[f].uc_stack.ss_size = STACK;
      makecontext(&fibers[f], run_fiber, 0);
    }
    for (bool more = true; more;) {
      int left = 0;
      joined_flag = false;
      for (int n = 0; n < THREADS; n++) {
        fiber = order ? THREADS - 1 - n : n;
        swapcontext(&caller, &fibers[fiber]);
        left += !finished[fiber];
      }
      answer = joined_flag;
      more = left == THREADS;
      wrong |= left != 0 && left != THREADS;
      if (wrong) break;
    }
  }
  free(chip);
  free(stacks);
  return wrong;
}
