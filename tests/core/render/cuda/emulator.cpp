// SPDX-License-Identifier: GPL-3.0-or-later
// Runs the CUDA text on the host: every thread of a block is a fibre, blocks run one by one.
//
// Barriers and the collective operations of a warp count arrivals: a fibre goes on only once all
// that the operation waits for have come, whatever order the branches let them come in. A block in
// which nobody can go on is reported. Shared memory is filled with NaN before each block, and the
// order in which fibres run can be turned round: results that then differ betray a missing barrier.
// Neither memory ordering nor speed is modelled.
//
// Compiled with -DKERNEL_TEXT="..." (the CUDA text) and -DKERNEL_TABLE="..." (one line per kernel).
#include <math.h>
#include <string.h>
#include <ucontext.h>

#include <algorithm>
#include <tuple>
#include <utility>
#include <vector>

using std::max;
using std::min;

struct Index3 {
    int x;
};
static Index3 blockIdx, threadIdx;
struct float4 {
    float x, y, z, w;
};
static inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

#define __global__
#define __device__ static
#define __forceinline__ inline
#define __launch_bounds__(threads)
#define __shared__ static __attribute__((section("emulated_shared")))

// The section exists even where a text has no shared memory.
__attribute__((used)) __shared__ char first_of_section;

static const int THREADS = 256;
static const size_t STACK_BYTES = 1 << 16;

// -- fibres ---------------------------------------------------------------------------------------

// A fibre runs the threads of one place in the order, block after block. Only those that can go on
// are switched to; the buffers are those of the compiler's own jumps, which save three words.
typedef void* Jump[5];
static Jump launcher, fibres[THREADS];
static bool started[THREADS];
static std::vector<char> stacks(THREADS * STACK_BYTES);
static unsigned long long ready[THREADS / 64]; // bit of each place whose fibre can go on
static int current, live;
static bool backward, stuck;
static void (*body)();

static int thread_at(int place) { return backward ? THREADS - 1 - place : place; }

// Return the next place that can go on, round and round; -1 for none.
static int next_place() {
    const int word = current >> 6, shift = current & 63;
    const unsigned long long later = shift == 63 ? 0 : ready[word] >> (shift + 1) << (shift + 1);
    if (later) return (word << 6) + __builtin_ctzll(later);
    for (int i = 1; i <= THREADS / 64; ++i) {
        const int w = (word + i) % (THREADS / 64);
        if (ready[w]) return (w << 6) + __builtin_ctzll(ready[w]);
    }
    return -1;
}

static void fibre();

__attribute__((noinline, noreturn)) static void back_to_launcher() {
    __builtin_longjmp(launcher, 1);
}

__attribute__((noinline, noreturn)) static void resume(int place) {
    if (place < 0) {
        stuck = live > 0;
        back_to_launcher();
    }
    current = place;
    threadIdx.x = thread_at(place);
    if (started[place]) __builtin_longjmp(fibres[place], 1);
    started[place] = true;
    ucontext_t context;
    getcontext(&context);
    context.uc_stack.ss_sp = &stacks[place * STACK_BYTES];
    context.uc_stack.ss_size = STACK_BYTES;
    context.uc_link = 0;
    makecontext(&context, fibre, 0);
    setcontext(&context);
    __builtin_unreachable();
}

// Let the others go on until this fibre is ready again.
__attribute__((noinline)) static void give_way() {
    ready[current >> 6] &= ~(1ull << (current & 63));
    if (__builtin_setjmp(fibres[current]) == 0) resume(next_place());
}

static void fibre() {
    for (;;) {
        body();
        --live;
        give_way(); // until the next block
    }
}

// Return whether the block ran to its end.
__attribute__((noinline)) static bool run_block() {
    for (unsigned long long& bits : ready) bits = ~0ull;
    live = THREADS;
    if (__builtin_setjmp(launcher) == 0) resume(0);
    if (stuck)
        for (bool& has : started) has = false;
    return !stuck;
}

// -- collective operations ------------------------------------------------------------------------

struct Meeting {
    int expected, arrived, generation;
    double values[2][THREADS]; // of two generations: a late reader never meets the next value
};
static Meeting block_meeting, warp_meetings[THREADS / 32];

// Bring a value, wait for the others, return everybody's values. Those who waited can go on then;
// they are all threads of the block, or those of the 32 places of this one.
static const double* meet(Meeting& meeting, int member, double value) {
    const double* values = meeting.values[meeting.generation & 1];
    meeting.values[meeting.generation & 1][member] = value;
    if (++meeting.arrived < meeting.expected) {
        give_way();
        return values;
    }
    meeting.arrived = 0;
    ++meeting.generation;
    if (meeting.expected == THREADS)
        for (unsigned long long& bits : ready) bits = ~0ull;
    else
        ready[current >> 6] |= 0xffffffffull << (current & 32);
    return values;
}

static void __syncthreads() { meet(block_meeting, threadIdx.x, 0.0); }
static int __syncthreads_and(int value) {
    const double* all = meet(block_meeting, threadIdx.x, value != 0);
    for (int t = 0; t < THREADS; ++t)
        if (all[t] == 0.0) return 0;
    return 1;
}
static const double* meet_warp(double value) {
    return meet(warp_meetings[threadIdx.x >> 5], threadIdx.x & 31, value);
}
static unsigned __ballot_sync(unsigned, int value) {
    const double* all = meet_warp(value != 0);
    unsigned bits = 0;
    for (int lane = 0; lane < 32; ++lane) bits |= (all[lane] != 0.0 ? 1u : 0u) << lane;
    return bits;
}
static int __all_sync(unsigned lanes, int value) { return __ballot_sync(lanes, value) == lanes; }
template <class T>
static T __shfl_sync(unsigned, T value, int lane) {
    return (T)meet_warp((double)value)[lane];
}
template <class T>
static T __shfl_xor_sync(unsigned, T value, int mask) {
    return (T)meet_warp((double)value)[(threadIdx.x & 31) ^ mask];
}

// -- arithmetic -----------------------------------------------------------------------------------

static inline int __ffs(unsigned bits) { return __builtin_ffs((int)bits); }
static inline float __int_as_float(int bits) {
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}
static inline float __fmul_rn(float a, float b) { return a * b; }
static inline float __fadd_rn(float a, float b) { return a + b; }

// The hardware's approximations may be off by this many units in the last place; set to test what
// that does. The sign alternates with the argument's bits, so that errors do not all agree.
static float approximation_ulp = 0.0f;
static inline float disturbed(float value, float argument, float ulp) {
    int bits;
    memcpy(&bits, &argument, sizeof bits);
    const float sign = (bits * 2654435761u) >> 31 ? 1.0f : -1.0f;
    return value * (1.0f + sign * ulp * 1.1920929e-7f);
}
static inline float approximate_exp(float x) {
    const float value = expf(x);
    return approximation_ulp == 0.0f
        ? value : disturbed(value, x, approximation_ulp * (2.0f + floorf(fabsf(1.173f * x))));
}
static inline float __fdividef(float a, float b) {
    const float value = a / b;
    return approximation_ulp == 0.0f ? value : disturbed(value, b, approximation_ulp * 2.0f);
}

#define __expf approximate_exp // libc has the name for itself
#include KERNEL_TEXT

// -- launching ------------------------------------------------------------------------------------

extern "C" char __start_emulated_shared[] __attribute__((visibility("hidden")));
extern "C" char __stop_emulated_shared[] __attribute__((visibility("hidden")));

static void** parameters;

template <class... A, size_t... I>
static void call(void (*kernel)(A...), std::index_sequence<I...>) {
    kernel(*(typename std::remove_const<A>::type*)parameters[I]...);
}
template <class... A>
static void call(void (*kernel)(A...)) {
    call(kernel, std::index_sequence_for<A...>());
}

struct Entry {
    const char* name;
    void (*run)();
};
static const Entry TABLE[] = {
#define KERNEL(name) {#name, [] { call(name); }},
#include KERNEL_TABLE
};

// 0 done, 1 no such kernel, 2 a block in which nobody could go on.
extern "C" int emulate(const char* name, int blocks, void** arguments, int backwards, float ulp) {
    for (const Entry& entry : TABLE) {
        if (strcmp(entry.name, name) != 0) continue;
        body = entry.run;
        parameters = arguments;
        backward = backwards;
        approximation_ulp = ulp;
        for (int b = 0; b < blocks; ++b) {
            blockIdx.x = b;
            memset(__start_emulated_shared, 0xff, __stop_emulated_shared - __start_emulated_shared);
            block_meeting.expected = THREADS;
            block_meeting.arrived = 0;
            for (Meeting& meeting : warp_meetings) {
                meeting.expected = 32;
                meeting.arrived = 0;
            }
            if (!run_block()) return 2;
        }
        return 0;
    }
    return 1;
}
