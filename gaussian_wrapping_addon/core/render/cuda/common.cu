// SPDX-License-Identifier: GPL-3.0-or-later
// Shared by all kernels: threads of a tile, one Gaussian evaluated on a ray, warp reductions.
//
// One source for NVRTC and, with a shim that defines CUDA's keywords, for a host compiler. The
// constants in capitals are prepended by kernels.py.

typedef long long int64;

#define BLOCK 256
#define WARPS 8
#define ALL_LANES 0xffffffffu
#define ROW_QUADS 6 // float4 values of one row of params

struct CameraValues {
    double v[22]; // as written by projection.pack_camera
};

// A warp of 32 threads covers 8 x 4 pixels of the tile: compact, so that few lanes diverge.
__device__ __forceinline__ int pixel_column(int thread) {
    return ((thread >> 5) & 1) * 8 + (thread & 7);
}
__device__ __forceinline__ int pixel_row(int thread) {
    return (thread >> 6) * 4 + ((thread >> 3) & 3);
}

// exp and quotients of the raster loops use the hardware's approximations: for arguments of exp
// down to -5.6 (below, alpha < 1/255) the documented error is 8 ulp, for quotients 2 ulp.
struct Hit {
    float dx, dy;   // pixel minus projected mean
    float den;      // sharpness of the ray's density over a0
    float inverse;  // 1 / den
    float distance; // smallest squared Mahalanobis distance on the ray
    float raw;      // opacity on the ray before the cap
};

// Written with explicit fused operations, so that every kernel rounds identically.
__device__ __forceinline__ Hit evaluate(const float4 a, const float4 b, const float4 c, float x, float y) {
    Hit hit;
    const float dx = x - a.x, dy = y - a.y;
    float num = fmaf(fmaf(a.z, dx, __fmul_rn(a.w, dy)), dx, __fmul_rn(__fmul_rn(b.x, dy), dy));
    num = fmaxf(num, 0.0f);
    const float linear = fmaf(b.w, dx, fmaf(c.x, dy, 2.0f * b.y));
    const float den = fmaf(linear, dx, fmaf(fmaf(c.y, dy, 2.0f * b.z), dy, 1.0f));
    hit.dx = dx;
    hit.dy = dy;
    hit.den = fmaxf(den, DENOMINATOR_MIN);
    hit.inverse = __fdividef(1.0f, hit.den);
    hit.distance = __fmul_rn(num, hit.inverse);
    hit.raw = __fmul_rn(__expf(__fmul_rn(-0.5f, hit.distance)), c.w);
    return hit;
}

// z-depth at which the density along the ray peaks.
__device__ __forceinline__ float peak_depth(const Hit& hit, const float4 b, float z) {
    return (1.0f + fmaf(b.y, hit.dx, b.z * hit.dy)) * hit.inverse * z;
}

__device__ __forceinline__ float warp_sum(float value) {
    for (int offset = 16; offset > 0; offset >>= 1)
        value += __shfl_xor_sync(ALL_LANES, value, offset);
    return value;
}
__device__ __forceinline__ float warp_max(float value) {
    for (int offset = 16; offset > 0; offset >>= 1)
        value = fmaxf(value, __shfl_xor_sync(ALL_LANES, value, offset));
    return value;
}

// One halving of the values that every lane of a warp holds: lanes whose bit `offset` is set keep
// the upper half, the others the lower one, each plus its partner's values.
template <int COUNT>
__device__ __forceinline__ void halve(float* values, int lane, int offset) {
    const bool upper = (lane & offset) != 0;
    constexpr int half = (COUNT + 1) / 2;
#pragma unroll
    for (int i = 0; i < half; ++i) {
        const float high = i + half < COUNT ? values[i + half] : 0.0f;
        const float kept = upper ? high : values[i];
        const float sent = upper ? values[i] : high;
        values[i] = kept + __shfl_xor_sync(ALL_LANES, sent, offset);
    }
}

// Sum 24 values over the warp with 24 shuffles instead of 120; each lane ends with the total of
// one column, in a fixed order of additions. Returns the column, or 24 for the spare lanes.
__device__ __forceinline__ int warp_row_sum(float* values, int lane, float* total) {
    halve<24>(values, lane, 16);
    halve<12>(values, lane, 8);
    halve<6>(values, lane, 4);
    halve<3>(values, lane, 2);
    halve<2>(values, lane, 1);
    *total = values[0];
    const int part = lane & 3;
    const int base = ((lane >> 4) & 1) * 12 + ((lane >> 3) & 1) * 6 + ((lane >> 2) & 1) * 3;
    return part < 3 ? base + part : 24;
}
