// SPDX-License-Identifier: GPL-3.0-or-later
// Losses on images and their gradients (docs/method.md, section 3): colour with SSIM, agreement of
// normals, confirmed depths. Formulas of image_metrics.py, losses.py and losses.py.

#define SSIM_RADIUS 5
#define SSIM_TAPS 11
#define PATCH (TILE + 2 * SSIM_RADIUS) // side of what the windows of a tile's pixels cover

// Sum of a value over the block, for thread 0, in a fixed order.
__device__ __forceinline__ float block_sum(float value, float* of_warps) {
    const int thread = threadIdx.x;
    const float sum = warp_sum(value);
    __syncthreads();
    if ((thread & 31) == 0) of_warps[thread >> 5] = sum;
    __syncthreads();
    float total = 0.0f;
    if (thread == 0)
        for (int w = 0; w < WARPS; ++w) total += of_warps[w];
    return total;
}

__device__ __forceinline__ float ssim_weight(int tap) {
    const float weights[6] = {SSIM_W0, SSIM_W1, SSIM_W2, SSIM_W3, SSIM_W4, SSIM_W5};
    return weights[tap <= SSIM_RADIUS ? tap : 2 * SSIM_RADIUS - tap];
}

struct SimilarityShared {
    float x[PATCH * PATCH], y[PATCH * PATCH];
    float rows[4][PATCH * TILE]; // filtered along the row
    float of_warps[WARPS];
};

// SSIM of the window around every pixel that has one (0 elsewhere), summed by block and channel,
// and its derivatives by E[x], E[x^2] and E[x y]: maps (3, 3, h, w), derivative, channel, pixel.
extern "C" __global__ void __launch_bounds__(BLOCK) ssim_maps(
    const float* image, const float* photo, const unsigned char* mask, int masked, int width,
    int height, int tiles_x, float* maps, float* sums) {
    __shared__ SimilarityShared shared;
    const int thread = threadIdx.x;
    const int left = (int)(blockIdx.x % tiles_x) * TILE, top = (int)(blockIdx.x / tiles_x) * TILE;
    const int x = left + thread % TILE, y = top + thread / TILE;
    const int64 pixels = (int64)width * height, pixel = (int64)y * width + x;
    const bool inside = x < width && y < height;
    const bool window = x >= SSIM_RADIUS && y >= SSIM_RADIUS && x < width - SSIM_RADIUS
        && y < height - SSIM_RADIUS && (!masked || mask[pixel]);
    for (int channel = 0; channel < 3; ++channel) {
        __syncthreads();
        for (int k = thread; k < PATCH * PATCH; k += BLOCK) {
            const int at_x = left + k % PATCH - SSIM_RADIUS, at_y = top + k / PATCH - SSIM_RADIUS;
            const int64 at = (int64)at_y * width + at_x;
            const bool counts = at_x >= 0 && at_y >= 0 && at_x < width && at_y < height
                && (!masked || mask[at]);
            shared.x[k] = counts ? image[3 * at + channel] : 0.0f;
            shared.y[k] = counts ? photo[3 * at + channel] : 0.0f;
        }
        __syncthreads();
        for (int k = thread; k < PATCH * TILE; k += BLOCK) {
            const int from = k / TILE * PATCH + k % TILE;
            float sx = 0.0f, sy = 0.0f, squares = 0.0f, product = 0.0f;
#pragma unroll
            for (int tap = 0; tap < SSIM_TAPS; ++tap) {
                const float weight = ssim_weight(tap);
                const float a = shared.x[from + tap], b = shared.y[from + tap];
                sx = fmaf(weight, a, sx);
                sy = fmaf(weight, b, sy);
                squares = fmaf(weight, fmaf(a, a, b * b), squares);
                product = fmaf(weight, a * b, product);
            }
            shared.rows[0][k] = sx;
            shared.rows[1][k] = sy;
            shared.rows[2][k] = squares;
            shared.rows[3][k] = product;
        }
        __syncthreads();
        float means[4] = {0.0f, 0.0f, 0.0f, 0.0f};
#pragma unroll
        for (int tap = 0; tap < SSIM_TAPS; ++tap) {
            const float weight = ssim_weight(tap);
#pragma unroll
            for (int q = 0; q < 4; ++q)
                means[q] = fmaf(weight, shared.rows[q][thread + tap * TILE], means[q]);
        }
        const float square = means[0] * means[0] + means[1] * means[1];
        const float product = means[0] * means[1];
        const float a1 = 2.0f * product + SSIM_C1, a2 = 2.0f * (means[3] - product) + SSIM_C2;
        const float b1 = square + SSIM_C1, b2 = means[2] - square + SSIM_C2;
        const float inverse = 1.0f / (b1 * b2), s = a1 * a2 * inverse;
        const float weight = window ? 2.0f * inverse : 0.0f;
        if (inside) {
            maps[channel * pixels + pixel] = weight * (means[1] * (a2 - a1) - s * means[0] * (b2 - b1));
            maps[(3 + channel) * pixels + pixel] = -0.5f * weight * s * b1;
            maps[(6 + channel) * pixels + pixel] = weight * a1;
        }
        const float sum = block_sum(window ? s : 0.0f, shared.of_warps);
        if (thread == 0) sums[3 * blockIdx.x + channel] = sum;
    }
}

struct GradientShared {
    float maps[3][PATCH * PATCH];
    float rows[3][PATCH * TILE];
    float of_warps[WARPS];
};

// Gradient of `step` x the sum of absolute errors + `scale` x the sum of SSIM, whose maps are not
// read where `similar` is 0; sums (blocks, 2): absolute and squared errors.
extern "C" __global__ void __launch_bounds__(BLOCK) color_gradient(
    const float* image, const float* photo, const unsigned char* mask, int masked, int width,
    int height, int tiles_x, const float* maps, int similar, float step, float scale,
    float* gradient, float* sums) {
    __shared__ GradientShared shared;
    const int thread = threadIdx.x;
    const int left = (int)(blockIdx.x % tiles_x) * TILE, top = (int)(blockIdx.x / tiles_x) * TILE;
    const int x = left + thread % TILE, y = top + thread / TILE;
    const int64 pixels = (int64)width * height, pixel = (int64)y * width + x;
    const bool counts = x < width && y < height && (!masked || mask[pixel]);
    float absolute = 0.0f, squared = 0.0f;
    for (int channel = 0; channel < 3; ++channel) {
        float found[3] = {0.0f, 0.0f, 0.0f};
        if (similar) {
            __syncthreads();
            for (int k = thread; k < PATCH * PATCH; k += BLOCK) {
                const int at_x = left + k % PATCH - SSIM_RADIUS, at_y = top + k / PATCH - SSIM_RADIUS;
                const bool held = at_x >= 0 && at_y >= 0 && at_x < width && at_y < height;
                const int64 at = (int64)at_y * width + at_x;
#pragma unroll
                for (int q = 0; q < 3; ++q)
                    shared.maps[q][k] = held ? maps[(3 * q + channel) * pixels + at] : 0.0f;
            }
            __syncthreads();
            for (int k = thread; k < PATCH * TILE; k += BLOCK) {
                const int from = k / TILE * PATCH + k % TILE;
#pragma unroll
                for (int q = 0; q < 3; ++q) {
                    float sum = 0.0f;
#pragma unroll
                    for (int tap = 0; tap < SSIM_TAPS; ++tap)
                        sum = fmaf(ssim_weight(tap), shared.maps[q][from + tap], sum);
                    shared.rows[q][k] = sum;
                }
            }
            __syncthreads();
#pragma unroll
            for (int tap = 0; tap < SSIM_TAPS; ++tap)
#pragma unroll
                for (int q = 0; q < 3; ++q)
                    found[q] = fmaf(ssim_weight(tap), shared.rows[q][thread + tap * TILE], found[q]);
        }
        if (x >= width || y >= height) continue;
        float value = 0.0f;
        if (counts) {
            const float a = image[3 * pixel + channel], b = photo[3 * pixel + channel];
            absolute += fabsf(a - b);
            squared = fmaf(a - b, a - b, squared);
            value = (a > b ? step : a < b ? -step : 0.0f)
                + scale * (found[0] + 2.0f * a * found[1] + b * found[2]);
        }
        gradient[3 * pixel + channel] = value;
    }
    const float first = block_sum(absolute, shared.of_warps);
    const float second = block_sum(squared, shared.of_warps);
    if (thread == 0) {
        sums[2 * blockIdx.x] = first;
        sums[2 * blockIdx.x + 1] = second;
    }
}


// Agreement of blended normals with those of the depth, one thread a pixel; `spread (4, h, w)`
// receives the gradients on the depths above, below, left and right of each pixel, and
// sums (blocks, 3) those of 1 - cos (geometric, learned) and the pixels that have a normal.
extern "C" __global__ void __launch_bounds__(BLOCK) agree_normals(
    int count, int width, int height, const float* depth, const float* alpha,
    const float* geometric, const float* learned, const unsigned char* mask, int masked,
    CameraValues camera, float weight_geometric, float weight_learned, float* by_geometric,
    float* by_learned, float* by_alpha, float* spread, float* sums) {
    __shared__ float of_warps[WARPS];
    const int p = blockIdx.x * BLOCK + threadIdx.x;
    const double* v = camera.v; // rotation (9), then fx, fy, cx, cy
    float off_geometric = 0.0f, off_learned = 0.0f, found = 0.0f;
    if (p < count) {
        const int column = p % width, row = p / width;
        float g[3], l[3], to_geometric[3] = {0, 0, 0}, to_learned[3] = {0, 0, 0};
        float to_alpha = 0.0f, to_up = 0.0f, to_down = 0.0f, to_left = 0.0f, to_right = 0.0f;
        const bool inner = column > 0 && row > 0 && column < width - 1 && row < height - 1;
        if (inner && (!masked || mask[p])) {
            const float up = depth[p - width], down = depth[p + width], here = depth[p];
            const float left = depth[p - 1], right = depth[p + 1], cover = alpha[p];
            const float fx = (float)(1.0 / v[9]), fy = (float)(1.0 / v[10]);
            const float x = (column + 0.5f - (float)v[11]) * fx, y = (float)((row + 0.5 - v[12]) / v[10]);
            const float high = down - up, wide = right - left;
            const float a0 = x * high, a1 = y * high + (down + up) * fy, a2 = high;
            const float b0 = x * wide + (right + left) * fx, b1 = y * wide, b2 = wide;
            const float c0 = a1 * b2 - a2 * b1, c1 = a2 * b0 - a0 * b2, c2 = a0 * b1 - a1 * b0;
            const float length_sq = c0 * c0 + c1 * c1 + c2 * c2;
            const float nearest = fminf(fminf(fminf(up, down), fminf(left, right)), fminf(here, cover));
            if (nearest > 0.0f && length_sq > MIN_NORMAL_SQ) {
                float r[9];
#pragma unroll
                for (int k = 0; k < 9; ++k) r[k] = (float)v[k];
#pragma unroll
                for (int c = 0; c < 3; ++c) g[c] = geometric[3 * p + c], l[c] = learned[3 * p + c];
                const float inverse = 1.0f / sqrtf(length_sq), share_cover = 1.0f / cover;
                const float n0 = c0 * inverse, n1 = c1 * inverse, n2 = c2 * inverse;
                float s[3]; // the depth's normal, scene frame
#pragma unroll
                for (int c = 0; c < 3; ++c) s[c] = r[c] * n0 + r[3 + c] * n1 + r[6 + c] * n2;
                const float cos_geometric = (g[0] * s[0] + g[1] * s[1] + g[2] * s[2]) * share_cover;
                const float cos_learned = l[0] * s[0] + l[1] * s[1] + l[2] * s[2];
                off_geometric = 1.0f - cos_geometric;
                off_learned = 1.0f - cos_learned;
                found = 1.0f;
                const float share = weight_geometric * share_cover;
                to_alpha = share * cos_geometric;
                float t[3];
#pragma unroll
                for (int c = 0; c < 3; ++c) {
                    to_geometric[c] = -share * s[c];
                    to_learned[c] = -weight_learned * s[c];
                    t[c] = share * g[c] + weight_learned * l[c];
                }
                // On the normal, in the camera frame.
                const float u0 = -(r[0] * t[0] + r[1] * t[1] + r[2] * t[2]);
                const float u1 = -(r[3] * t[0] + r[4] * t[1] + r[5] * t[2]);
                const float u2 = -(r[6] * t[0] + r[7] * t[1] + r[8] * t[2]);
                const float along = n0 * u0 + n1 * u1 + n2 * u2;
                const float d0 = (u0 - n0 * along) * inverse, d1 = (u1 - n1 * along) * inverse;
                const float d2 = (u2 - n2 * along) * inverse;
                // d(a x b) . d = da . (b x d) + db . (d x a)
                const float p0 = b1 * d2 - b2 * d1, p1 = b2 * d0 - b0 * d2, p2 = b0 * d1 - b1 * d0;
                const float q0 = d1 * a2 - d2 * a1, q1 = d2 * a0 - d0 * a2, q2 = d0 * a1 - d1 * a0;
                const float ray_p = x * p0 + y * p1 + p2, ray_q = x * q0 + y * q1 + q2;
                to_up = p1 * fy - ray_p;
                to_down = p1 * fy + ray_p;
                to_left = q0 * fx - ray_q;
                to_right = q0 * fx + ray_q;
            }
        }
#pragma unroll
        for (int c = 0; c < 3; ++c) {
            by_geometric[3 * (int64)p + c] = to_geometric[c];
            by_learned[3 * (int64)p + c] = to_learned[c];
        }
        by_alpha[p] = to_alpha;
        spread[p] = to_up;
        spread[(int64)count + p] = to_down;
        spread[2 * (int64)count + p] = to_left;
        spread[3 * (int64)count + p] = to_right;
    }
    const float first = block_sum(off_geometric, of_warps);
    const float second = block_sum(off_learned, of_warps);
    const float third = block_sum(found, of_warps);
    if (threadIdx.x == 0) {
        sums[3 * blockIdx.x] = first;
        sums[3 * blockIdx.x + 1] = second;
        sums[3 * blockIdx.x + 2] = third;
    }
}

// The gradient on each depth from those that its four neighbours have on it.
extern "C" __global__ void __launch_bounds__(BLOCK) gather_depth(
    int count, int width, int height, const float* spread, float* by_depth) {
    const int p = blockIdx.x * BLOCK + threadIdx.x;
    if (p >= count) return;
    const int column = p % width, row = p / width;
    const int64 plane = count;
    float sum = 0.0f;
    if (row < height - 1) sum += spread[p + width];
    if (row > 0) sum += spread[plane + p - width];
    if (column < width - 1) sum += spread[2 * plane + p + 1];
    if (column > 0) sum += spread[3 * plane + p - 1];
    by_depth[p] = sum;
}

// Loss on depths that leave those that stereo confirmed, added to `by_depth`; lens: fx, fy, cx, cy
// of the image and of the prior's.
extern "C" __global__ void __launch_bounds__(BLOCK) prior_depths(
    int count, int width, const float* depth, const float* prior, const float* confidence,
    int prior_width, int prior_height, const unsigned char* mask, int masked, CameraValues lens,
    float weight, float* by_depth, float* sums) {
    __shared__ float of_warps[WARPS];
    const int p = blockIdx.x * BLOCK + threadIdx.x;
    const double* v = lens.v;
    float total = 0.0f;
    if (p < count && (!masked || mask[p])) {
        const double y = (p / width + 0.5 - v[3]) / v[1] * v[5] + v[7];
        const double x = (p % width + 0.5 - v[2]) / v[0] * v[4] + v[6];
        const int row = min(max((int)y, 0), prior_height - 1);
        const int column = min(max((int)x, 0), prior_width - 1);
        const int64 at = (int64)row * prior_width + column;
        const double there = prior[at], here = depth[p];
        if (there > 0.0 && here > 0.0) {
            double off = (here - there) / there;
            if (fabs(off) < PRIOR_OUTLIER) {
                const double trust = (double)weight * confidence[at];
                off /= PRIOR_TOLERANCE;
                const bool near = fabs(off) < 1.0;
                total = (float)(trust * (near ? 0.5 * off * off : fabs(off) - 0.5));
                const double slope = near ? off : off > 0.0 ? 1.0 : -1.0;
                by_depth[p] += (float)(trust * slope / (PRIOR_TOLERANCE * there));
            }
        }
    }
    const float sum = block_sum(total, of_warps);
    if (threadIdx.x == 0) sums[blockIdx.x] = sum;
}
