// SPDX-License-Identifier: GPL-3.0-or-later
// Transmittance from one camera to points anywhere (docs/method.md, section 5.3): formulas,
// lists and cut-offs of vacancy_kernels.py, where they are explained.
//
// A warp takes 32 points of one tile that lie close together on the screen. It scans the tile's
// list 32 Gaussians at a time, one per lane, and evaluates those whose footprint reaches the box of
// its points. No shared memory and no barrier, so that warps end independently.

#define CELL_SHIFT 4 // a tile has 16 x 16 cells, only to order its points
#define LEFT_OUT 0x7fffffff

// Spread the bits of 0..15 to even positions.
__device__ __forceinline__ int spread_bits(int value) {
    value = (value | value << 2) & 0x33;
    return (value | value << 1) & 0x55;
}

// One thread per point: pixel and z-depth, and the key that orders points by tile and, within it,
// along a Z-curve. Points that are settled, off the image or in a masked pixel get LEFT_OUT. In
// mask mode 2 ("background") points in a masked pixel are settled as empty.
extern "C" __global__ void __launch_bounds__(BLOCK) locate_points(
    int count, const double* points, CameraValues camera, float settled, int tile_px, int tiles_x,
    int tiles_y, const unsigned char* mask, int mask_mode, int mask_width, int mask_height,
    int camera_index, float* best, int* winner, unsigned char* seen, float* screen, int* keys) {
    const int p = blockIdx.x * BLOCK + threadIdx.x;
    if (p >= count) return;
    keys[p] = LEFT_OUT;
    if (best[p] > settled) return;
    const double x = points[3 * (int64)p], y = points[3 * (int64)p + 1], z = points[3 * (int64)p + 2];
    const double w = camera.v[6] * x + camera.v[7] * y + camera.v[8] * z + camera.v[11];
    if (!(w > camera.v[21])) return; // also if a coordinate is NaN
    const double across = camera.v[0] * x + camera.v[1] * y + camera.v[2] * z + camera.v[9];
    const double along = camera.v[3] * x + camera.v[4] * y + camera.v[5] * z + camera.v[10];
    const double u = camera.v[15] * across / w + camera.v[17];
    const double v = camera.v[16] * along / w + camera.v[18];
    if (!(u >= 0.0 && v >= 0.0 && u <= camera.v[19] && v <= camera.v[20])) return;
    if (mask_mode != 0) {
        // From rounded pixels, as on the CPU.
        const int column = min((int)((float)u * (mask_width / camera.v[19])), mask_width - 1);
        const int row = min((int)((float)v * (mask_height / camera.v[20])), mask_height - 1);
        if (!mask[(int64)row * mask_width + column]) {
            if (mask_mode == 2) {
                best[p] = 1.0f;
                winner[p] = camera_index;
                seen[p] = 1;
            }
            return;
        }
    }
    seen[p] = 1;
    screen[3 * (int64)p] = (float)u;
    screen[3 * (int64)p + 1] = (float)v;
    screen[3 * (int64)p + 2] = (float)w;
    const double cell_px = (double)tile_px / (1 << CELL_SHIFT);
    const int column = min((int)(u / cell_px), (tiles_x << CELL_SHIFT) - 1);
    const int row = min((int)(v / cell_px), (tiles_y << CELL_SHIFT) - 1);
    const int tile = (row >> CELL_SHIFT) * tiles_x + (column >> CELL_SHIFT);
    const int inner = (1 << CELL_SHIFT) - 1;
    keys[p] = tile << (2 * CELL_SHIFT) | spread_bits(row & inner) << 1 | spread_bits(column & inner);
}

// 1 - G where the ray to a point passes a Gaussian, or is still before its peak; rows of
// vacancy_kernels.ROW_COLUMNS.
__device__ __forceinline__ float let_through(const float4* row, float x, float y, float depth) {
    const float4 a = row[0], b = row[1], c = row[2], d = row[3];
    const float dx = x - a.x, dy = y - a.y;
    const float num = fmaf(fmaf(a.z, dx, __fmul_rn(a.w, dy)), dx, __fmul_rn(__fmul_rn(b.x, dy), dy));
    const float linear = fmaf(b.w, dx, fmaf(c.x, dy, 2.0f * b.y));
    const float den = fmaf(linear, dx, fmaf(fmaf(c.y, dy, 2.0f * b.z), dy, 1.0f));
    const float sharpness = fmaxf(den, DENOMINATOR_MIN);
    const float inverse = __fdividef(1.0f, sharpness);
    const float foot = num < 0.0f ? 0.0f : __fmul_rn(num, inverse); // NaN is preserved
    // Written so that NaN gives full transmittance.
    if (!(foot <= d.y && depth >= d.z)) return 1.0f;
    const float peak = __fmul_rn(__fmul_rn(fmaf(b.y, dx, fmaf(b.z, dy, 1.0f)), inverse), c.z);
    const float ahead = fmaxf(peak - depth, 0.0f);
    const float lack = __fmul_rn(__fmul_rn(__fmul_rn(ahead, ahead), sharpness), c.w);
    const float value = __fmul_rn(d.x, __expf(__fmul_rn(-0.5f, foot + lack)));
    return fmaxf(1.0f - value, FACTOR_MIN);
}

// Raise best and winner of all points by one camera. Tile t holds the points order[point_start[t]]
// to order[point_start[t + 1] - 1], and the warps group_start[t] to group_start[t + 1] - 1 take
// them. A product below TRANSMITTANCE_LOST counts as 0. Ties go to the lower camera index.
extern "C" __global__ void __launch_bounds__(BLOCK) transmittance_tiles(
    int tiles, int camera_index, const int64* group_start, const int64* point_start,
    const int64* order, const float* screen, const float4* rows, const float4* bounds,
    const int64* tile_start, const int* tile_ids, float* best, int* winner) {
    const int lane = threadIdx.x & 31;
    const int64 group = (int64)blockIdx.x * WARPS + (threadIdx.x >> 5);
    if (group >= group_start[tiles]) return;
    int tile = 0, beyond = tiles; // the last tile that does not begin after the group
    while (beyond - tile > 1) {
        const int middle = (tile + beyond) >> 1;
        if (group_start[middle] <= group) tile = middle;
        else beyond = middle;
    }
    const int64 first = point_start[tile] + 32 * (group - group_start[tile]);
    const bool used = first + lane < point_start[tile + 1];
    const int64 p = order[used ? first + lane : first]; // spare lanes repeat a point
    const float x = screen[3 * p], y = screen[3 * p + 1], depth = screen[3 * p + 2];
    const float x0 = -warp_max(-x), x1 = warp_max(x), y0 = -warp_max(-y), y1 = warp_max(y);
    const float deepest = warp_max(depth);
    const float middle_x = 0.5f * (x0 + x1), middle_y = 0.5f * (y0 + y1);
    const float half_x = 0.5f * (x1 - x0), half_y = 0.5f * (y1 - y0);
    const float to_beat = used ? fmaxf(best[p], TRANSMITTANCE_LOST) : 1.0f;
    float product = used ? 1.0f : 0.0f;
    const int64 end = tile_start[tile + 1];
    for (int64 at = tile_start[tile]; at < end; at += 32) {
        int id = 0;
        bool near = at + lane < end;
        if (near) {
            id = tile_ids[at + lane];
            const float4 box = bounds[2 * (int64)id], strip = bounds[2 * (int64)id + 1];
            const float outside = fabsf(strip.x * middle_x + strip.y * middle_y - strip.z) - strip.w;
            near = box.x <= x1 && box.z >= x0 && box.y <= y1 && box.w >= y0
                && rows[4 * (int64)id + 3].z <= deepest
                && !(outside > half_x * fabsf(strip.x) + half_y * fabsf(strip.y));
        }
        unsigned pending = __ballot_sync(ALL_LANES, near);
        if (pending == 0u) continue;
        while (pending != 0u) {
            const int64 i = __shfl_sync(ALL_LANES, id, __ffs(pending) - 1);
            pending &= pending - 1u;
            product *= let_through(rows + 4 * i, x, y, depth);
        }
        if (__ballot_sync(ALL_LANES, product >= to_beat) == 0u) break; // no point can be raised any more
    }
    if (!used) return;
    const float value = product < TRANSMITTANCE_LOST ? 0.0f : product;
    if (value > best[p] || (value == best[p] && camera_index < winner[p])) {
        best[p] = value;
        winner[p] = camera_index;
    }
}
