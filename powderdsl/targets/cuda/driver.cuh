// The kernel around the generated passes: worlds into the block, steps, worlds back.

struct Worlds {
  u32* planes;    // [worlds][SLOTS][WORDS]
  float* reals;   // [worlds][REALS][HEIGHT][WIDTH]
  u32* scratch;   // [blocks][SCRATCH_WORDS]
  const u64 *seed, *index, *step;
  const unsigned char* flags;  // [PARAM_PLANES][worlds]
  const float* numbers;        // [PARAM_REALS][worlds]
  int worlds, steps;
};
DEVICE int world_of(const Worlds& a, int l) {  // the last block's places that no world has repeat the last world
  const int world = BLOCK * GROUP + l;
  return world < a.worlds ? world : a.worlds - 1;
}
DEVICE void load(const Block& c, const Worlds& a) {
  for (int n = THREAD; n < 2 * GROUP; n += THREADS) {
    const int l = n % GROUP, world = world_of(a, l);
    u32 k = n < GROUP ? 0x243F6A88u : 0x85A308D3u;
    k = mix(k + (u32)a.seed[world]);
    k = mix(k + (u32)(a.seed[world] >> 32));
    chip[AT_BASE + n] = mix(k + (u32)a.index[world]);
  }
  for (int n = THREAD; n < PARAM_PLANES * GROUP; n += THREADS)
    chip[AT_FLAGS + n] = spread(a.flags[(size_t)(n / GROUP) * a.worlds + world_of(a, n % GROUP)]);
  for (int n = THREAD; n < PARAM_REALS * GROUP; n += THREADS)
    ((float*)chip)[AT_NUMBERS + n] = a.numbers[(size_t)(n / GROUP) * a.worlds + world_of(a, n % GROUP)];
  FOR_WORDS(k, i) {
    PLACE(i);
    const u32* from = a.planes + (size_t)world_of(a, l) * SLOTS * WORDS + at;
    for (int s = 0; s < SLOTS; s++) P(s)[i] = from[(size_t)s * WORDS];
  }
  for (int s = 0; s < FIELDS; s++)  // what is no slot's begins as nothing: where a field lives must always be right
    FOR_BUSY_WORDS(i, [](int) { return true; }) {
      PLACE(i);
      const float* from = a.reals + ((size_t)world_of(a, l) * REALS + s) * HEIGHT * WIDTH;
      u32 lives = 0;
      LANES {
        CELL;
        const float v = s < REALS ? from[y * WIDTH + x] : 0.0f;
        if (inside) F(s)[cell] = v;
        BALLOT(lives, inside && v != 0);
      }
      ONCE N(s)[i] = lives;
    }
}
DEVICE void store(const Block& c, const Worlds& a) {
  FOR_WORDS(k, i) {
    PLACE(i);
    const int world = BLOCK * GROUP + l;
    if (world < a.worlds)
      for (int s = 0; s < SLOTS; s++) a.planes[((size_t)world * SLOTS + s) * WORDS + at] = P(s)[i];
  }
  for (int s = 0; s < REALS; s++)
    FOR_BUSY_WORDS(i, [](int) { return true; }) {
      PLACE(i);
      const int world = BLOCK * GROUP + l;
      LANES {
        CELL;
        if (inside && world < a.worlds) a.reals[((size_t)world * REALS + s) * HEIGHT * WIDTH + y * WIDTH + x] = F(s)[cell];
      }
    }
}
DEVICE void begin_step(const Block& c, const Worlds& a, int done) {
  for (int n = THREAD; n < 2 * STREAMS * GROUP; n += THREADS) {
    const int l = n % GROUP, half = n / GROUP % 2, stream = n / GROUP / 2;
    const u32 step = (u32)(a.step[world_of(a, l)] + (u64)done);
    chip[AT_KEYS + n] = mix(mix(chip[AT_BASE + half * GROUP + l] + step) + STREAM_IDENT[stream]);
  }
  for (int n = THREAD; n < STEP_PLANES * GROUP; n += THREADS) {
    const u64 step = a.step[world_of(a, n % GROUP)] + (u64)done;
    chip[AT_STEP + n] = spread(step % STEP_MODULUS[n / GROUP] >> STEP_BIT[n / GROUP] & 1);
  }
  reset_slots(c);
}
KERNEL powderdsl_steps(Worlds a) {
  Block c;
  c.planes = a.scratch + (size_t)BLOCK * SCRATCH_WORDS;
  c.fields = c.planes + (PLANES_ON_CHIP ? 0 : PLANE_WORDS);
  load(c, a);
  for (int done = 0; done < a.steps; done++) {
    SYNC();
    begin_step(c, a, done);
    SYNC();
    run_passes(c);
  }
  SYNC();
  store(c, a);
}
