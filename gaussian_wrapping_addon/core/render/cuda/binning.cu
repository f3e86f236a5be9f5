// SPDX-License-Identifier: GPL-3.0-or-later
// The tiles that each Gaussian's ellipse reaches: counts and unsorted list of intersections of a
// band of tile rows. Formulas and float64 of tile_kernels.py; torch sorts them by tile.

// First and last tile column of Gaussian i in a tile row.
__device__ __forceinline__ void tile_columns(
    int row, const int* range, float4 box, float skew_px, int* first, int* last) {
    *first = range[2] / TILE;
    *last = range[3] / TILE;
    if (*first == *last || range[0] / TILE == range[1] / TILE || !(fabsf(skew_px) < FLOAT32_LARGE))
        return;
    const double half_x = 0.5 * ((double)box.z - (double)box.x);
    const double half_y = 0.5 * ((double)box.w - (double)box.y);
    if (!(half_x > 0.0 && half_y > 0.0)) return;
    const double center_x = 0.5 * ((double)box.z + (double)box.x);
    const double center_y = 0.5 * ((double)box.w + (double)box.y);
    const double skew = skew_px;
    const int top_px = max(row * TILE, range[0]);
    const int bottom_px = min(row * TILE + TILE - 1, range[1]);
    const double top = fmax((top_px + 0.5 - STRIP_MARGIN - center_y) / half_y, -1.0);
    const double bottom = fmin((bottom_px + 0.5 + STRIP_MARGIN - center_y) / half_y, 1.0);
    if (top > bottom) return;
    // At height t (in half heights) the ellipse spans skew t +- across sqrt(1 - t^2).
    const double across_sq = half_x * half_x * (1.0 + SHARE_MARGIN) - skew * skew;
    const double across = across_sq > 0.0 ? sqrt(across_sq) : 0.0;
    const double extreme = skew / half_x;
    double t = fmin(fmax(extreme, top), bottom);
    const double right = skew * t + across * sqrt(fmax(1.0 - t * t, 0.0));
    t = fmin(fmax(-extreme, top), bottom);
    const double left = skew * t - across * sqrt(fmax(1.0 - t * t, 0.0));
    const double margin = STRIP_MARGIN + SHARE_MARGIN * half_x;
    double first_px = ceil(center_x + left - margin - 0.5);
    double last_px = floor(center_x + right + margin - 0.5);
    first_px = fmin(fmax(first_px, (double)range[2]), (double)(range[3] + 1));
    last_px = fmax(fmin(last_px, (double)range[3]), (double)(range[2] - 1));
    if (first_px > last_px) {
        *last = *first - 1;
        return;
    }
    *first = (int)first_px / TILE;
    *last = (int)last_px / TILE;
}

// First and last row, first and last column of the pixels whose centres lie in the box.
__device__ __forceinline__ void pixel_range(float4 box, int width, int height, int* range) {
    range[0] = (int)fmax(ceil((double)box.y - 0.5), 0.0);
    range[1] = (int)fmin(floor((double)box.w - 0.5), height - 1.0);
    range[2] = (int)fmax(ceil((double)box.x - 0.5), 0.0);
    range[3] = (int)fmin(floor((double)box.z - 0.5), width - 1.0);
}

extern "C" __global__ void __launch_bounds__(BLOCK) count_pairs(
    int count, const float4* boxes, const float* skews, const unsigned char* visible,
    int width, int height, int first_row, int end_row, int64* pair_counts) {
    const int i = blockIdx.x * BLOCK + threadIdx.x;
    if (i >= count) return;
    int64 pairs = 0;
    if (visible[i]) {
        int range[4], first, last;
        pixel_range(boxes[i], width, height, range);
        const int end = min(range[1] / TILE + 1, end_row);
        for (int row = max(range[0] / TILE, first_row); row < end; ++row) {
            tile_columns(row, range, boxes[i], skews[i], &first, &last);
            pairs += last - first + 1;
        }
    }
    pair_counts[i] = pairs;
}

// The thread of rank k lists the tiles of Gaussian order[k], row by row, so that its slots are
// contiguous and the list is in blending order. Tiles are numbered from the band's first row.
extern "C" __global__ void __launch_bounds__(BLOCK) list_pairs(
    int count, const int64* order, const int64* rank_offsets, const int64* pair_offsets,
    const float4* boxes, const float* skews, int width, int height, int tiles_x, int first_row,
    int end_row, int* tiles, int* gaussian_ids, int* pair_slots) {
    const int k = blockIdx.x * BLOCK + threadIdx.x;
    if (k >= count) return;
    int64 place = rank_offsets[k];
    const int64 place_end = rank_offsets[k + 1];
    if (place == place_end) return;
    const int64 i = order[k];
    int slot = (int)pair_offsets[i];
    int range[4], first, last;
    pixel_range(boxes[i], width, height, range);
    const int end = min(range[1] / TILE + 1, end_row);
    for (int row = max(range[0] / TILE, first_row); row < end; ++row) {
        tile_columns(row, range, boxes[i], skews[i], &first, &last);
        for (int column = first; column <= last; ++column) {
            tiles[place] = (row - first_row) * tiles_x + column;
            gaussian_ids[place] = (int)i;
            pair_slots[place] = slot++;
            ++place;
        }
    }
}
