// SPDX-License-Identifier: GPL-3.0-or-later
// Gradient of blending and depth, front to back, one block per tile: the formulas of
// raster.py. Each warp sums its pixels, each block its warps in order, each intersection
// writes its own slot, each Gaussian sums its slots in order: no atomics, bitwise reproducible.

#define BACKWARD_BATCH 16

struct BackwardShared {
    float4 rows[BACKWARD_BATCH * ROW_QUADS];
    unsigned masks[BACKWARD_BATCH * WARPS];
    float sums[BACKWARD_BATCH * WARPS * 24];
};

template <bool DEPTH, bool ABSOLUTE>
__device__ __forceinline__ void backward_tile(
    BackwardShared& shared, const float4* params, const int64* start, const int* gaussian_ids,
    const int* pair_slots, const unsigned* masks, int tiles_x, int first_row, int width, int height,
    const float* color, const float* normal, const float* geometric, const float* alpha_image,
    const float* depth_image, const float* slope_image, const float* g_color, const float* g_normal,
    const float* g_geometric, const float* g_alpha, const float* g_depth, float* pairs) {
    const int thread = threadIdx.x, warp = thread >> 5, lane = thread & 31;
    const int x = (int)(blockIdx.x % tiles_x) * TILE + pixel_column(thread);
    const int y = (first_row + (int)(blockIdx.x / tiles_x)) * TILE + pixel_row(thread);
    const float at_x = x + 0.5f, at_y = y + 0.5f;
    float g[9] = {0, 0, 0, 0, 0, 0, 0, 0, 0};
    float through = 1.0f, remaining = 0.0f, surface = 0.0f, pull = 0.0f;
    if (x < width && y < height) {
        const int64 pixel = (int64)y * width + x;
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            g[c] = g_color[3 * pixel + c];
            g[3 + c] = g_normal[3 * pixel + c];
            g[6 + c] = g_geometric[3 * pixel + c];
            // The colour includes the background, and with it the final transmittance.
            remaining += g[c] * color[3 * pixel + c] + g[3 + c] * normal[3 * pixel + c]
                + g[6 + c] * geometric[3 * pixel + c];
        }
        remaining -= g_alpha[pixel] * (1.0f - alpha_image[pixel]);
        if (DEPTH) {
            surface = depth_image[pixel];
            if (surface > 0.0f) pull = g_depth[pixel] / slope_image[pixel];
        }
    }
    const int64 begin = start[blockIdx.x], end = start[blockIdx.x + 1];
    for (int64 first = begin; first < end; first += BACKWARD_BATCH) {
        const int listed = (int)(end - first < BACKWARD_BATCH ? end - first : BACKWARD_BATCH);
        __syncthreads();
        for (int j = thread; j < listed * ROW_QUADS; j += BLOCK)
            shared.rows[j] = params[(int64)gaussian_ids[first + j / ROW_QUADS] * ROW_QUADS + j % ROW_QUADS];
        for (int j = thread; j < listed * WARPS; j += BLOCK) shared.masks[j] = masks[first * WARPS + j];
        __syncthreads();
        for (int k = 0; k < listed; ++k) {
            const unsigned mask = shared.masks[k * WARPS + warp];
            if (mask == 0u) continue;
            float v[24];
#pragma unroll
            for (int c = 0; c < 24; ++c) v[c] = 0.0f;
            if (mask >> lane & 1u) {
                const float4* row = shared.rows + k * ROW_QUADS;
                const float4 a = row[0], b = row[1], c = row[2], d = row[3], e = row[4], f = row[5];
                const Hit hit = evaluate(a, b, c, at_x, at_y);
                const float dx = hit.dx, dy = hit.dy;
                const float alpha = fminf(hit.raw, ALPHA_MAX);
                const float weight = alpha * through;
                const float q = g[0] * d.y + g[1] * d.z + g[2] * d.w + g[3] * e.x + g[4] * e.y
                    + g[5] * e.z + g[6] * e.w + g[7] * f.x + g[8] * f.y;
                remaining -= weight * q;
                const float g_alpha_here = through * q - __fdividef(remaining, 1.0f - alpha);
                through = fmaf(-alpha, through, through);
                float g_distance = hit.raw < ALPHA_MAX ? -0.5f * alpha * g_alpha_here : 0.0f;
                float g_den = 0.0f, g_lin = 0.0f;
                if (DEPTH && pull != 0.0f) {
                    const float sharpness = d.x * hit.den;
                    const float line = 1.0f + fmaf(b.y, dx, b.z * dy);
                    const float peak = line * hit.inverse * c.z;
                    const float ahead = fmaxf(peak - surface, 0.0f);
                    const float density = hit.raw * __expf(-0.5f * sharpness * ahead * ahead);
                    // Gradient on log G, through log(1 - G).
                    const float g_log = density < ALPHA_MAX ? -pull * __fdividef(density, 1.0f - density) : 0.0f;
                    const float g_peak = -g_log * sharpness * ahead;
                    const float g_sharpness = -0.5f * g_log * ahead * ahead;
                    g_distance -= 0.5f * g_log;
                    g_den = d.x * g_sharpness - g_peak * peak * hit.inverse;
                    g_lin = g_peak * hit.inverse * c.z;
                    v[10] = g_lin * line / c.z;
                    v[12] = g_sharpness * hit.den;
                }
                const float g_num = g_distance * hit.inverse;
                g_den -= g_num * hit.distance;
                const float g_u = g_num * (2.0f * a.z * dx + a.w * dy)
                    + g_den * (2.0f * (b.y + b.w * dx) + c.x * dy) + g_lin * b.y;
                const float g_v = g_num * (2.0f * b.x * dy + a.w * dx)
                    + g_den * (2.0f * (b.z + c.y * dy) + c.x * dx) + g_lin * b.z;
                v[0] = -g_u;
                v[1] = -g_v;
                v[2] = g_num * dx * dx;
                v[3] = g_num * dx * dy;
                v[4] = g_num * dy * dy;
                v[5] = (2.0f * g_den + g_lin) * dx;
                v[6] = (2.0f * g_den + g_lin) * dy;
                v[7] = g_den * dx * dx;
                v[8] = g_den * dx * dy;
                v[9] = g_den * dy * dy;
                v[11] = -2.0f * g_distance / c.w;
#pragma unroll
                for (int channel = 0; channel < 9; ++channel) v[13 + channel] = weight * g[channel];
                if (ABSOLUTE) {
                    v[22] = fabsf(g_u);
                    v[23] = fabsf(g_v);
                }
            }
            float total;
            const int column = warp_row_sum(v, lane, &total);
            if (column < 24) shared.sums[(k * WARPS + warp) * 24 + column] = total;
        }
        __syncthreads();
        for (int j = thread; j < listed * 24; j += BLOCK) {
            const int k = j / 24, column = j % 24;
            float sum = 0.0f;
#pragma unroll
            for (int w = 0; w < WARPS; ++w)
                if (shared.masks[k * WARPS + w] != 0u) sum += shared.sums[(k * WARPS + w) * 24 + column];
            pairs[(int64)pair_slots[first + k] * 24 + column] = sum;
        }
    }
}

#define BACKWARD_KERNEL(name, depth, absolute)                                                     \
    extern "C" __global__ void __launch_bounds__(BLOCK) name(                                      \
        const float4* params, const int64* start, const int* gaussian_ids, const int* pair_slots,  \
        const unsigned* masks, int tiles_x, int first_row, int width, int height,                  \
        const float* color, const float* normal, const float* geometric, const float* alpha_image, \
        const float* depth_image, const float* slope_image, const float* g_color,                  \
        const float* g_normal, const float* g_geometric, const float* g_alpha,                     \
        const float* g_depth, float* pairs) {                                                      \
        __shared__ BackwardShared shared;                                                          \
        backward_tile<depth, absolute>(                                                            \
            shared, params, start, gaussian_ids, pair_slots, masks, tiles_x, first_row, width,     \
            height, color, normal, geometric, alpha_image, depth_image, slope_image, g_color,      \
            g_normal, g_geometric, g_alpha, g_depth, pairs);                                       \
    }

BACKWARD_KERNEL(backward_tiles, false, false)
BACKWARD_KERNEL(backward_tiles_depth, true, false)
BACKWARD_KERNEL(backward_tiles_absolute, false, true)
BACKWARD_KERNEL(backward_tiles_depth_absolute, true, true)

// Add each Gaussian's intersection rows to its row, in the order of the slots: one warp per
// Gaussian, one lane per column, so that reads are coalesced.
extern "C" __global__ void __launch_bounds__(BLOCK) sum_pairs(
    int count, const float* pairs, const int64* pair_offsets, float* grad_params) {
    const int i = blockIdx.x * WARPS + (threadIdx.x >> 5), column = threadIdx.x & 31;
    if (i >= count || column >= 24) return;
    const int64 first = pair_offsets[i], end = pair_offsets[i + 1];
    if (first == end) return;
    float sum = grad_params[(int64)i * 24 + column];
    for (int64 slot = first; slot < end; ++slot) sum += pairs[slot * 24 + column];
    grad_params[(int64)i * 24 + column] = sum;
}

// Set rows that overflow float32 to 0 and, if asked for, write the norms of the gradient on (u, v)
// and of its sum of absolute values over pixels (AbsGS); params have no columns 22 and 23.
extern "C" __global__ void __launch_bounds__(BLOCK) finish_params(
    int count, int with_norms, float* grad_params, float* grad_px, float* grad_abs_px) {
    const int i = blockIdx.x * BLOCK + threadIdx.x;
    if (i >= count) return;
    float* row = grad_params + (int64)i * 24;
    // In float64: squares of float32 overflow beyond 1e19.
    double size = 0.0;
    for (int column = 0; column < 24; ++column) size += fabs((double)row[column]);
    if (!(size <= FLOAT32_MAX))
        for (int column = 0; column < 24; ++column) row[column] = 0.0f;
    if (!with_norms) return;
    const double u = row[0], v = row[1], absolute_u = row[22], absolute_v = row[23];
    grad_px[i] = (float)sqrt(u * u + v * v);
    grad_abs_px[i] = (float)sqrt(absolute_u * absolute_u + absolute_v * absolute_v);
    row[22] = row[23] = 0.0f;
}
