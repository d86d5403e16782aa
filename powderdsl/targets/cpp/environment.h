/* The environment @TASK of powderdsl: `worlds` episodes at once, each in a world of its own, which begin anew by
   themselves. Compile the C++ file beside this header with your program, for your processor:

     g++ -std=c++17 -O2 -march=native -ffp-contract=off -c env.cpp && cc program.c env.o -lstdc++ -lpthread -lm

   Actions are POWDER_ACTION_NUMBERS numbers, each from 0 to below its place in POWDER_ACTION_VALUES. */
#ifndef POWDER_ENVIRONMENT
#define POWDER_ENVIRONMENT
#include <stdint.h>

/* CONSTANTS */
static const int64_t POWDER_ACTION_VALUES[] = {/* VALUES */};

#ifdef __cplusplus
extern "C" {
#endif
typedef struct powder_env powder_env;

/* New environments; NULL if there are none. */
powder_env* powder_new(int worlds);
void powder_free(powder_env* env);

/* Begins all episodes. Environment i has the seed `seed` + i, which decides its worlds.
   Observations are [worlds][POWDER_OBSERVATION_BYTES]. */
void powder_reset(powder_env* env, uint64_t seed, uint8_t* observations);

/* Acts once in each episode: actions [worlds][POWDER_ACTION_NUMBERS]; all others [worlds]. Where an episode ends, the
   observation is the first of the next one. Returns -1, or the place of the first number that is out of range: nothing
   has changed then. */
int64_t powder_step(powder_env* env, const int64_t* actions, uint8_t* observations, float* rewards,
                    uint8_t* terminated, uint8_t* truncated);
#ifdef __cplusplus
}
#endif
#endif
