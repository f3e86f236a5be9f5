// SPDX-License-Identifier: GPL-3.0-or-later
// Blending of tiles, front to back: one block per tile, one thread per pixel. Besides the images
// it writes, for each intersection and warp, the mask of the pixels that the Gaussian contributed
// to. Depth and gradient use these masks: all three share their contributors and skip the rest.

#define FORWARD_BATCH 64

struct ForwardShared {
    float4 rows[FORWARD_BATCH * ROW_QUADS];
    unsigned masks[FORWARD_BATCH * WARPS];
    unsigned reached[FORWARD_BATCH]; // bit w: the ellipse may reach the pixels of warp w
};
struct WeightShared {
    float sums[FORWARD_BATCH * WARPS], largest[FORWARD_BATCH * WARPS];
};

// Bits of the warps' 8 x 4 pixels that an ellipse reaches in the tile at (left, top). Within the 8
// columns of each half the rows are narrowed as in tile_kernels.py, here in float32: only for
// ellipses near the tile's size, where the margin covers its rounding.
__device__ __forceinline__ unsigned reached_warps(float4 box, float skew, int left, int top) {
    const float x0 = box.x - left, y0 = box.y - top, x1 = box.z - left, y1 = box.w - top;
    const float first_row = fmaxf(ceilf(y0 - 0.5f), 0.0f), last_row = fminf(floorf(y1 - 0.5f), TILE - 1.0f);
    const float half_x = 0.5f * (x1 - x0), half_y = 0.5f * (y1 - y0);
    const float center_x = 0.5f * (x1 + x0), center_y = 0.5f * (y1 + y0);
    const bool narrow = half_x > 0.0f && half_y > 0.0f && half_x < NARROW_PX && half_y < NARROW_PX
        && fabsf(skew) <= half_x;
    unsigned bits = 0;
#pragma unroll
    for (int half = 0; half < 2; ++half) {
        const float from = half * 8 + 0.5f, to = from + 7.0f; // pixel centres
        if (!(x0 <= to && x1 >= from)) continue;
        float first = first_row, last = last_row;
        if (narrow) {
            const float begin = fmaxf((from - NARROW_MARGIN - center_x) / half_x, -1.0f);
            const float end = fminf((to + NARROW_MARGIN - center_x) / half_x, 1.0f);
            // At x = t half_x the ellipse spans slope t +- across sqrt(1 - t^2) in y.
            const float extreme = skew / half_x, slope = extreme * half_y;
            const float across = half_y * sqrtf(fmaxf(1.0f + 2e-6f - extreme * extreme, 0.0f));
            float t = fminf(fmaxf(extreme, begin), end);
            const float bottom = slope * t + across * sqrtf(fmaxf(1.0f - t * t, 0.0f));
            t = fminf(fmaxf(-extreme, begin), end);
            const float upper = slope * t - across * sqrtf(fmaxf(1.0f - t * t, 0.0f));
            first = fmaxf(first, ceilf(center_y + upper - NARROW_MARGIN - 0.5f));
            last = fminf(last, floorf(center_y + bottom + NARROW_MARGIN - 0.5f));
        }
#pragma unroll
        for (int block = 0; block < 4; ++block)
            if (first <= block * 4 + 3.0f && last >= block * 4.0f && first <= last)
                bits |= 1u << (2 * block + half);
    }
    return bits;
}

template <bool WEIGHTS>
__device__ __forceinline__ void forward_tile(
    ForwardShared& shared, WeightShared* weighed, const float4* params, const float4* boxes,
    const float* skews, const int64* start, const int* gaussian_ids, const int* pair_slots,
    int tiles_x, int first_row, int width, int height, float red, float green, float blue,
    float* color, float* normal, float* geometric, float* alpha_image, unsigned* masks,
    float* pair_weights, int* strongest) {
    const int thread = threadIdx.x, warp = thread >> 5, lane = thread & 31;
    const int left = (int)(blockIdx.x % tiles_x) * TILE;
    const int top = (first_row + (int)(blockIdx.x / tiles_x)) * TILE;
    const int x = left + pixel_column(thread), y = top + pixel_row(thread);
    const bool inside = x < width && y < height;
    const float at_x = x + 0.5f, at_y = y + 0.5f;
    const int64 begin = start[blockIdx.x], end = start[blockIdx.x + 1];
    float through = inside ? 1.0f : 0.0f; // pixels outside start opaque: nothing contributes
    float f0 = 0, f1 = 0, f2 = 0, f3 = 0, f4 = 0, f5 = 0, f6 = 0, f7 = 0, f8 = 0;
    float best = 0.0f;
    int best_id = -1;
    for (int64 first = begin; first < end; first += FORWARD_BATCH) {
        // Also keeps the loads below from overwriting what the last batch still reads.
        if (__syncthreads_and(through < TRANSMITTANCE_MIN)) break;
        const int listed = (int)(end - first < FORWARD_BATCH ? end - first : FORWARD_BATCH);
        for (int j = thread; j < listed * ROW_QUADS; j += BLOCK)
            shared.rows[j] = params[(int64)gaussian_ids[first + j / ROW_QUADS] * ROW_QUADS + j % ROW_QUADS];
        for (int j = thread; j < listed * WARPS; j += BLOCK) {
            shared.masks[j] = 0;
            if (WEIGHTS) weighed->sums[j] = weighed->largest[j] = 0.0f;
        }
        if (thread < listed) {
            const int i = gaussian_ids[first + thread];
            shared.reached[thread] = reached_warps(boxes[i], skews[i], left, top);
        }
        __syncthreads();
        for (int k = 0; k < listed; ++k) {
            if (!(shared.reached[k] >> warp & 1u)) continue;
            const float4* row = shared.rows + k * ROW_QUADS;
            const float4 c = row[2];
            const Hit hit = evaluate(row[0], row[1], c, at_x, at_y);
            const float alpha = fminf(hit.raw, ALPHA_MAX);
            const bool contributes = alpha >= ALPHA_MIN && through >= TRANSMITTANCE_MIN;
            const unsigned mask = __ballot_sync(ALL_LANES, contributes);
            if (mask == 0) continue;
            if (lane == 0) shared.masks[k * WARPS + warp] = mask;
            const float weight = contributes ? alpha * through : 0.0f;
            if (contributes) {
                const float4 d = row[3], e = row[4], f = row[5];
                through = fmaf(-alpha, through, through);
                f0 = fmaf(weight, d.y, f0), f1 = fmaf(weight, d.z, f1), f2 = fmaf(weight, d.w, f2);
                f3 = fmaf(weight, e.x, f3), f4 = fmaf(weight, e.y, f4), f5 = fmaf(weight, e.z, f5);
                f6 = fmaf(weight, e.w, f6), f7 = fmaf(weight, f.x, f7), f8 = fmaf(weight, f.y, f8);
            }
            if (WEIGHTS) {
                if (weight > best) best = weight, best_id = gaussian_ids[first + k];
                const float sum = warp_sum(weight), largest = warp_max(weight);
                if (lane == 0) {
                    weighed->sums[k * WARPS + warp] = sum;
                    weighed->largest[k * WARPS + warp] = largest;
                }
            }
            if (__all_sync(ALL_LANES, through < TRANSMITTANCE_MIN)) break;
        }
        __syncthreads();
        for (int j = thread; j < listed * WARPS; j += BLOCK) masks[first * WARPS + j] = shared.masks[j];
        if (WEIGHTS && thread < listed) {
            float sum = 0.0f, largest = 0.0f;
            for (int w = 0; w < WARPS; ++w) {
                sum += weighed->sums[thread * WARPS + w];
                largest = fmaxf(largest, weighed->largest[thread * WARPS + w]);
            }
            const int64 slot = pair_slots[first + thread];
            pair_weights[2 * slot] = sum;
            pair_weights[2 * slot + 1] = largest;
        }
    }
    if (!inside) return;
    const int64 pixel = (int64)y * width + x;
    color[3 * pixel] = fmaf(through, red, f0);
    color[3 * pixel + 1] = fmaf(through, green, f1);
    color[3 * pixel + 2] = fmaf(through, blue, f2);
    normal[3 * pixel] = f3, normal[3 * pixel + 1] = f4, normal[3 * pixel + 2] = f5;
    geometric[3 * pixel] = f6, geometric[3 * pixel + 1] = f7, geometric[3 * pixel + 2] = f8;
    alpha_image[pixel] = 1.0f - through;
    if (WEIGHTS) strongest[pixel] = best_id;
}

#define FORWARD_PARAMETERS                                                                         \
    const float4 *params, const float4 *boxes, const float *skews, const int64 *start,             \
        const int *gaussian_ids, const int *pair_slots, int tiles_x, int first_row, int width,     \
        int height, float red, float green, float blue, float *color, float *normal,               \
        float *geometric, float *alpha_image, unsigned *masks, float *pair_weights, int *strongest
#define FORWARD_ARGUMENTS                                                                          \
    params, boxes, skews, start, gaussian_ids, pair_slots, tiles_x, first_row, width, height, red, \
        green, blue, color, normal, geometric, alpha_image, masks, pair_weights, strongest

// `masks (intersections, 8)` and, with weights, `pair_weights (intersections, 2)` must be 0 before.
extern "C" __global__ void __launch_bounds__(BLOCK) forward_tiles(FORWARD_PARAMETERS) {
    __shared__ ForwardShared shared;
    forward_tile<false>(shared, (WeightShared*)0, FORWARD_ARGUMENTS);
}
extern "C" __global__ void __launch_bounds__(BLOCK) forward_tiles_weights(FORWARD_PARAMETERS) {
    __shared__ ForwardShared shared;
    __shared__ WeightShared weighed;
    forward_tile<true>(shared, &weighed, FORWARD_ARGUMENTS);
}

// Sum and maximum of the blending weights of each Gaussian over its intersections, in the order of
// its slots, accumulated over bands.
extern "C" __global__ void __launch_bounds__(BLOCK) sum_weights(
    int count, const float* pair_weights, const int64* pair_offsets, float* weight_sum, float* weight_max) {
    const int i = blockIdx.x * BLOCK + threadIdx.x;
    if (i >= count) return;
    float sum = weight_sum[i], largest = weight_max[i];
    for (int64 slot = pair_offsets[i]; slot < pair_offsets[i + 1]; ++slot) {
        sum += pair_weights[2 * slot];
        largest = fmaxf(largest, pair_weights[2 * slot + 1]);
    }
    weight_sum[i] = sum;
    weight_max[i] = largest;
}
