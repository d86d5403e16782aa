// Stands before a generated kernel so that it compiles as plain C++: threads are fibers that run one after the other,
// each from barrier to barrier. A barrier that is missing lets one fiber run ahead of the others and shows as a
// difference. Loops over cells give words to other fibers than loops over words do, as on a GPU.
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <ucontext.h>

#define EMULATED 1
#define THREADS 5
#define DEVICE static inline
#define OUTLINE static
#define KERNEL extern "C" void
#define TABLE static const
#define THREAD fiber
#define BLOCK block
#define WARPS THREADS
#define SYNC() ((void)any_fiber(false))
#define ANY(x) any_fiber(x)
#define LANES for (int lane = 0; lane < 32; lane++)
#define ONCE
#define BALLOT(word, flag) word |= (u32)(flag) << lane
#define ROOT(x) __builtin_sqrtf(x)
#define MAGNITUDE(x) __builtin_fabsf(x)

static int fiber, block;
static unsigned int* chip;
static bool any_fiber(bool flag);

template <class Need> static unsigned int busy_words(int base, Need need);
static inline int word_of(int base, unsigned int) { return base + (fiber + 1) % THREADS; }
static inline unsigned int funnel(unsigned int low, unsigned int high, int by) { return low >> by | high << (32 - by); }
