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
#include <setjmp.h>
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

static jmp_buf scheduler, fibres[THREADS];
static std::vector<char> stacks(THREADS * STACK_BYTES);
static bool ended[THREADS];
static int current, direction = 1, idle;
static void (*body)();

static void give_way() {
    if (_setjmp(fibres[current]) == 0) _longjmp(scheduler, 1);
}

static void fibre() {
    body();
    ended[current] = true;
    _longjmp(scheduler, 1);
}

// Return whether the block ran to its end.
static bool run_block() {
    for (int t = 0; t < THREADS; ++t) ended[t] = false;
    std::vector<bool> started(THREADS, false);
    volatile int live = THREADS;
    idle = 0;
    current = direction > 0 ? THREADS - 1 : 0;
    while (live > 0) {
        do current = (current + direction + THREADS) % THREADS;
        while (ended[current]);
        threadIdx.x = current;
        if (_setjmp(scheduler) == 0) {
            if (started[current]) _longjmp(fibres[current], 1);
            started[current] = true;
            ucontext_t context;
            getcontext(&context);
            context.uc_stack.ss_sp = &stacks[current * STACK_BYTES];
            context.uc_stack.ss_size = STACK_BYTES;
            context.uc_link = 0;
            makecontext(&context, fibre, 0);
            setcontext(&context);
        }
        if (ended[current]) {
            --live;
            idle = 0;
        } else if (++idle > 2 * THREADS) {
            return false;
        }
    }
    return true;
}

// -- collective operations ------------------------------------------------------------------------

struct Meeting {
    int expected, arrived, generation;
    double values[2][THREADS]; // of two generations: a late reader never meets the next value
};
static Meeting block_meeting, warp_meetings[THREADS / 32];

// Bring a value, wait for the others, return everybody's values.
static const double* meet(Meeting& meeting, int member, double value) {
    const int generation = meeting.generation;
    meeting.values[generation & 1][member] = value;
    idle = 0;
    if (++meeting.arrived == meeting.expected) {
        meeting.arrived = 0;
        ++meeting.generation;
    } else {
        while (meeting.generation == generation) give_way();
        idle = 0;
    }
    return meeting.values[generation & 1];
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
        direction = backwards ? -1 : 1;
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
