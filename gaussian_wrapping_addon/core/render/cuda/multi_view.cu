// SPDX-License-Identifier: GPL-3.0-or-later
// Multi-view terms between two views: pixel choice, reprojection, patch comparison; the formulas
// of multi_view.py and multi_view.py, where they are explained.
//
// Arrays of sampled pixels have a fixed length, so that their number need not be known: an entry
// of -1 is no pixel. `camera` is the reference camera; `pair` is the other one, its pose relative
// to the reference camera's frame. Masks may be null. All values are float64 except images, depths
// and positions.

// -- pixel choice ---------------------------------------------------------------------------------

// Rounded as on the CPU: both choose the same pixels.
extern "C" __global__ void __launch_bounds__(BLOCK) grey_pixels(
    int count, const unsigned char* photo, float red, float green, float blue, float* grey) {
    const int64 p = (int64)blockIdx.x * BLOCK + threadIdx.x;
    if (p >= count) return;
    const float sum = fmaf(red, (float)photo[3 * p], __fmul_rn(green, (float)photo[3 * p + 1]));
    grey[p] = fmaf(blue, (float)photo[3 * p + 2], sum);
}

// The pixel at a place of the order that runs through blocks of pixels, row by row.
__device__ __forceinline__ void pixel_at(int place, int width, int height, int block, int* row, int* column) {
    const int top = place / (block * width) * block, rows = min(block, height - top);
    const int inner = place - top * width;
    const int left = inner / (block * rows) * block, columns = min(block, width - left);
    const int last = inner - left * rows;
    *row = top + last / columns;
    *column = left + last % columns;
}

// Length of the brightness gradient by place, -1 for pixels that cannot be chosen.
extern "C" __global__ void __launch_bounds__(BLOCK) measure_pixels(
    int count, int width, int height, int block, int border, const float* grey, const float* depth,
    const unsigned char* mask, float* steepness) {
    const int place = blockIdx.x * BLOCK + threadIdx.x;
    if (place >= count) return;
    int row, column;
    pixel_at(place, width, height, block, &row, &column);
    const int64 p = (int64)row * width + column;
    float length = -1.0f;
    if (row >= border && row < height - border && column >= border && column < width - border
        && depth[p] > 0.0f && (!mask || mask[p])) {
        const float across = grey[p + 1] - grey[p - 1], down = grey[p + width] - grey[p - width];
        const float found = sqrtf(__fmul_rn(across, across) + __fmul_rn(down, down));
        if (found < INFINITE) length = found;
    }
    steepness[place] = length;
}

// First place whose running sum exceeds a value; `places` if none does.
__device__ __forceinline__ int place_beyond(const double* running, int places, double value) {
    int low = 0, high = places;
    while (low < high) {
        const int middle = low + (high - low) / 2;
        if (value < running[middle]) high = middle;
        else low = middle + 1;
    }
    return low;
}

// The pixel of each stratum's draw, -1 where the draw before has selected it already.
extern "C" __global__ void __launch_bounds__(BLOCK) pick_pixels(
    int count, int width, int height, int block, const double* jitter, const double* running,
    const double* total, int* pixels) {
    const int k = blockIdx.x * BLOCK + threadIdx.x;
    if (k >= count) return;
    const double stratum = *total / count;
    const int places = width * height;
    const int place = place_beyond(running, places, (k + jitter[k]) * stratum);
    int pixel = -1;
    if (place < places
        && (k == 0 || place != place_beyond(running, places, (k - 1 + jitter[k - 1]) * stratum))) {
        int row, column;
        pixel_at(place, width, height, block, &row, &column);
        pixel = row * width + column;
    }
    pixels[k] = pixel;
}

// -- reprojection ---------------------------------------------------------------------------------

__device__ __forceinline__ bool on_image(double x, double y, const CameraValues& camera) {
    return x >= 0.0 && y >= 0.0 && x <= camera.v[19] && y <= camera.v[20];
}

// Positions of pixels in the other view (NaN where they have none), derivatives by their depth.
extern "C" __global__ void __launch_bounds__(BLOCK) lift_points(
    int count, const int* pixels, int width, const float* depth, CameraValues camera,
    CameraValues pair, const unsigned char* other_mask, float* positions, double* position_slopes) {
    const int64 k = (int64)blockIdx.x * BLOCK + threadIdx.x;
    if (k >= count) return;
    positions[2 * k] = positions[2 * k + 1] = INFINITE - INFINITE;
    position_slopes[2 * k] = position_slopes[2 * k + 1] = 0.0;
    const int pixel = pixels[k];
    if (pixel < 0) return;
    const double z = depth[pixel];
    const double x = (pixel % width + 0.5 - camera.v[17]) / camera.v[15];
    const double y = (pixel / width + 0.5 - camera.v[18]) / camera.v[16];
    const double a0 = pair.v[0] * x + pair.v[1] * y + pair.v[2];
    const double a1 = pair.v[3] * x + pair.v[4] * y + pair.v[5];
    const double a2 = pair.v[6] * x + pair.v[7] * y + pair.v[8];
    const double h2 = a2 * z + pair.v[11];
    if (!(h2 > pair.v[21])) return;
    const double u = (a0 * z + pair.v[9]) / h2, v = (a1 * z + pair.v[10]) / h2;
    const double at_x = pair.v[15] * u + pair.v[17], at_y = pair.v[16] * v + pair.v[18];
    if (!on_image(at_x, at_y, pair)) return;
    const int other_width = (int)pair.v[19], other_height = (int)pair.v[20];
    const int64 at = (int64)min((int)at_y, other_height - 1) * other_width + min((int)at_x, other_width - 1);
    if (other_mask && !other_mask[at]) return;
    positions[2 * k] = (float)at_x;
    positions[2 * k + 1] = (float)at_y;
    position_slopes[2 * k] = pair.v[15] * (a0 - u * a2) / h2;
    position_slopes[2 * k + 1] = pair.v[16] * (a1 - v * a2) / h2;
}

// Reprojection error of pixels (the noise, inf where there is none), derivatives by the other
// view's depth and position, and the weight exp(-noise).
extern "C" __global__ void __launch_bounds__(BLOCK) return_points(
    int count, const int* pixels, int width, const float* positions, const float* found,
    CameraValues camera, CameraValues pair, double* noise, double* weights, double* by_found,
    double* by_positions) {
    const int64 k = (int64)blockIdx.x * BLOCK + threadIdx.x;
    if (k >= count) return;
    noise[k] = INFINITE;
    weights[k] = by_found[k] = by_positions[2 * k] = by_positions[2 * k + 1] = 0.0;
    const int pixel = pixels[k];
    const double z = found[k];
    if (pixel < 0 || !(z > pair.v[21])) return;
    const double x = (positions[2 * k] - pair.v[17]) / pair.v[15];
    const double y = (positions[2 * k + 1] - pair.v[18]) / pair.v[16];
    const double c0 = x * z - pair.v[9], c1 = y * z - pair.v[10], c2 = z - pair.v[11];
    const double b0 = pair.v[0] * c0 + pair.v[3] * c1 + pair.v[6] * c2;
    const double b1 = pair.v[1] * c0 + pair.v[4] * c1 + pair.v[7] * c2;
    const double b2 = pair.v[2] * c0 + pair.v[5] * c1 + pair.v[8] * c2;
    if (!(b2 > pair.v[21])) return;
    const double at_x = camera.v[15] * b0 / b2 + camera.v[17];
    const double at_y = camera.v[16] * b1 / b2 + camera.v[18];
    const double off_x = at_x - (pixel % width + 0.5), off_y = at_y - (pixel / width + 0.5);
    const double length = sqrt(off_x * off_x + off_y * off_y);
    if (!(length < MAX_NOISE_PX && on_image(at_x, at_y, camera))) return;
    noise[k] = length;
    weights[k] = exp(-length);
    if (length < MIN_NOISE_PX) return;
    const double g0 = camera.v[15] * off_x / (length * b2), g1 = camera.v[16] * off_y / (length * b2);
    const double g2 = -(g0 * b0 + g1 * b1) / b2;
    const double e0 = pair.v[0] * g0 + pair.v[1] * g1 + pair.v[2] * g2;
    const double e1 = pair.v[3] * g0 + pair.v[4] * g1 + pair.v[5] * g2;
    const double e2 = pair.v[6] * g0 + pair.v[7] * g1 + pair.v[8] * g2;
    by_found[k] = e0 * x + e1 * y + e2;
    by_positions[2 * k] = e0 * z / pair.v[15];
    by_positions[2 * k + 1] = e1 * z / pair.v[16];
}

// -- patches --------------------------------------------------------------------------------------

#define PATCH_SIDE (2 * HALF_PATCH + 1)
#define PATCH_SAMPLES (PATCH_SIDE * PATCH_SIDE)
#define LANE_SAMPLES ((PATCH_SAMPLES + 31) / 32)

__device__ __forceinline__ double warp_total(double value) {
    for (int offset = 16; offset > 0; offset >>= 1)
        value += __shfl_xor_sync(ALL_LANES, value, offset);
    return value;
}

// Four pixels around a position between pixel centres, and the weights of the right and lower ones.
struct Corner {
    float upper_left, upper_right, lower_left, lower_right;
    double right, low;
};

// Return false if the position is not between pixel centres or one of the pixels is masked.
__device__ __forceinline__ bool find_corner(
    const float* grey, const unsigned char* mask, int width, int height, double x, double y, Corner& c) {
    if (!(x >= 0.5 && y >= 0.5 && x <= width - 0.5 && y <= height - 0.5)) return false;
    const int column = min(max((int)(x - 0.5), 0), width - 2), row = min(max((int)(y - 0.5), 0), height - 2);
    const int64 at = (int64)row * width + column;
    if (mask && !(mask[at] && mask[at + 1] && mask[at + width] && mask[at + width + 1])) return false;
    c.right = x - 0.5 - column;
    c.low = y - 0.5 - row;
    c.upper_left = grey[at], c.upper_right = grey[at + 1];
    c.lower_left = grey[at + width], c.lower_right = grey[at + width + 1];
    return true;
}

struct Sample {
    double ours, theirs, slope, ratio; // slope: derivative of `theirs` by the ratio
};

// What the terms read of the two views.
struct PatchImages {
    const float *depth, *grey, *other_grey;
    const unsigned char *mask, *other_mask;
    int width, height;
};

// A patch's plane in the camera's frame, and the surface's allowed deviation from it.
struct PatchPlane {
    double n0, n1, n2, facing, z, rise;
};

// The grey levels of sample (i, j) of a patch in both photos; false where the patch has none.
__device__ __forceinline__ bool take_sample(
    const PatchImages& images, const PatchPlane& plane, const CameraValues& camera,
    const CameraValues& pair, int row, int column, int i, int j, double step_px, Sample& sample) {
    const double at_x = column + 0.5 + step_px * j, at_y = row + 0.5 + step_px * i;
    Corner c;
    if (!find_corner(images.grey, images.mask, images.width, images.height, at_x, at_y, c)) return false;
    double high = c.upper_left + c.right * (c.upper_right - c.upper_left);
    double below = c.lower_left + c.right * (c.lower_right - c.lower_left);
    sample.ours = high + c.low * (below - high);
    const double x = (at_x - camera.v[17]) / camera.v[15], y = (at_y - camera.v[18]) / camera.v[16];
    const double ratio = (plane.n0 * x + plane.n1 * y + plane.n2) / (plane.facing * plane.z);
    const double h0 = pair.v[0] * x + pair.v[1] * y + pair.v[2] + ratio * pair.v[9];
    const double h1 = pair.v[3] * x + pair.v[4] * y + pair.v[5] + ratio * pair.v[10];
    const double h2 = pair.v[6] * x + pair.v[7] * y + pair.v[8] + ratio * pair.v[11];
    if (!(ratio > 0.0 && h2 > pair.v[21] * ratio)) return false;
    // On the rim the surface must lie near the plane.
    if (i % HALF_PATCH == 0 && j % HALF_PATCH == 0 && (i != 0 || j != 0)) {
        const double there = images.depth[(int64)at_y * images.width + (int)at_x];
        if (!(fabs(there * ratio - 1.0) < plane.rise * step_px)) return false;
    }
    const double u = h0 / h2, v = h1 / h2;
    const double to_x = pair.v[15] * u + pair.v[17], to_y = pair.v[16] * v + pair.v[18];
    const int other_width = (int)pair.v[19], other_height = (int)pair.v[20];
    if (!find_corner(images.other_grey, images.other_mask, other_width, other_height, to_x, to_y, c)) return false;
    const double g00 = c.upper_left, g01 = c.upper_right, g10 = c.lower_left, g11 = c.lower_right;
    high = g00 + c.right * (g01 - g00);
    below = g10 + c.right * (g11 - g10);
    sample.theirs = high + c.low * (below - high);
    const double across = (g01 - g00) + c.low * ((g11 - g10) - (g01 - g00));
    sample.slope = (across * pair.v[15] * (pair.v[9] - u * pair.v[11])
                    + (below - high) * pair.v[16] * (pair.v[10] - v * pair.v[11])) / h2;
    sample.ratio = ratio;
    return true;
}

struct PatchResult {
    double error, by_depth, d0, d1, d2; // derivatives by depth and by the normal, camera's frame
};

// Compare the patches around one pixel. All lanes return the same state; each takes two samples.
__device__ __forceinline__ int compare_patch(
    const PatchImages& images, const float* normals, const float* alpha, const CameraValues& camera,
    const CameraValues& pair, int pixel, bool squared, int sizes, double max_rise, double min_spread,
    int lane, PatchResult& out) {
    const int row = pixel / images.width, column = pixel % images.width;
    const double s0 = normals[3 * (int64)pixel], s1 = normals[3 * (int64)pixel + 1];
    const double s2 = normals[3 * (int64)pixel + 2];
    const double length = sqrt(s0 * s0 + s1 * s1 + s2 * s2);
    if (!(length >= MIN_PLANE_NORMAL * alpha[pixel] && length > 0.0)) return PATCH_SKIPPED;
    PatchPlane plane;
    plane.z = images.depth[pixel];
    plane.n0 = (camera.v[0] * s0 + camera.v[1] * s1 + camera.v[2] * s2) / length;
    plane.n1 = (camera.v[3] * s0 + camera.v[4] * s1 + camera.v[5] * s2) / length;
    plane.n2 = (camera.v[6] * s0 + camera.v[7] * s1 + camera.v[8] * s2) / length;
    const double px = (column + 0.5 - camera.v[17]) / camera.v[15];
    const double py = (row + 0.5 - camera.v[18]) / camera.v[16];
    plane.facing = plane.n0 * px + plane.n1 * py + plane.n2; // n . r_p
    if (!(fabs(plane.facing) >= MIN_PLANE_FACING * sqrt(px * px + py * py + 1.0))) return PATCH_SKIPPED;
    plane.rise = max_rise * HALF_PATCH / camera.v[15];
    double step_px = 0.5 * PATCH_STEP_PX;
    double our_spread = 0.0, their_spread = 0.0, common = 0.0;
    Sample samples[LANE_SAMPLES];
    bool flat = true;
    for (int size = 0; size < sizes && flat; ++size) {
        step_px *= 2.0;
        bool whole = true;
#pragma unroll
        for (int h = 0; h < LANE_SAMPLES; ++h) {
            const int s = lane + 32 * h;
            samples[h].ours = samples[h].theirs = samples[h].slope = samples[h].ratio = 0.0;
            if (s < PATCH_SAMPLES)
                whole = whole && take_sample(images, plane, camera, pair, row, column,
                                             s / PATCH_SIDE - HALF_PATCH, s % PATCH_SIDE - HALF_PATCH,
                                             step_px, samples[h]);
        }
        if (!__all_sync(ALL_LANES, whole)) return PATCH_SKIPPED;
        double our_sum = 0.0, their_sum = 0.0;
#pragma unroll
        for (int h = 0; h < LANE_SAMPLES; ++h) {
            our_sum += samples[h].ours;
            their_sum += samples[h].theirs;
        }
        const double our_mean = warp_total(our_sum) / PATCH_SAMPLES;
        const double their_mean = warp_total(their_sum) / PATCH_SAMPLES;
        our_spread = their_spread = common = 0.0;
#pragma unroll
        for (int h = 0; h < LANE_SAMPLES; ++h) {
            if (lane + 32 * h >= PATCH_SAMPLES) continue;
            samples[h].ours -= our_mean;
            samples[h].theirs -= their_mean;
            our_spread += samples[h].ours * samples[h].ours;
            their_spread += samples[h].theirs * samples[h].theirs;
            common += samples[h].ours * samples[h].theirs;
        }
        our_spread = warp_total(our_spread);
        their_spread = warp_total(their_spread);
        common = warp_total(common);
        flat = !(our_spread > min_spread && their_spread > min_spread);
    }
    if (flat) return PATCH_SKIPPED;
    const double product = our_spread * their_spread + SPREAD_PRODUCT;
    const double root = sqrt(product), correlation = common / root;
    const double agreement = squared ? correlation * correlation : correlation;
    if (!(fabs(agreement) < INFINITE)) return PATCH_BROKEN;
    out.error = fmin(fmax(1.0 - agreement, 0.0), 2.0);
    if (!(out.error < MAX_PATCH_ERROR)) return PATCH_SKIPPED;
    const double chain = squared ? -2.0 * correlation : -1.0;
    const double pull = common * our_spread / product;
    double by_depth = 0.0, d0 = 0.0, d1 = 0.0, d2 = 0.0;
#pragma unroll
    for (int h = 0; h < LANE_SAMPLES; ++h) {
        const int s = lane + 32 * h;
        if (s >= PATCH_SAMPLES) continue;
        const double by_ratio = chain * (samples[h].ours - pull * samples[h].theirs) / root * samples[h].slope;
        const double share = samples[h].ratio * plane.z;
        by_depth -= by_ratio * samples[h].ratio;
        d0 += by_ratio * (px + step_px * (s % PATCH_SIDE - HALF_PATCH) / camera.v[15] - share * px);
        d1 += by_ratio * (py + step_px * (s / PATCH_SIDE - HALF_PATCH) / camera.v[16] - share * py);
        d2 += by_ratio * (1.0 - share);
    }
    const double inverse = 1.0 / (plane.facing * plane.z * length);
    out.by_depth = warp_total(by_depth) / plane.z;
    out.d0 = warp_total(d0) * inverse;
    out.d1 = warp_total(d1) * inverse;
    out.d2 = warp_total(d2) * inverse;
    return fabs(out.by_depth + out.d0 + out.d1 + out.d2) < INFINITE ? PATCH_KEPT : PATCH_BROKEN;
}

// One warp per pixel: compare its patch with the other photo, warped by its plane.
extern "C" __global__ void __launch_bounds__(BLOCK) compare_patches(
    int count, const int* pixels, const double* noise, int width, int height, const float* depth,
    const float* normals, const float* alpha, CameraValues camera, CameraValues pair,
    const float* grey, const float* other_grey, const unsigned char* mask,
    const unsigned char* other_mask, int squared, int sizes, double max_rise, double min_spread,
    unsigned char* states, double* errors, double* by_depth, double* by_normals) {
    const int lane = threadIdx.x & 31;
    const int64 k = (int64)blockIdx.x * WARPS + (threadIdx.x >> 5);
    if (k >= count) return;
    const PatchImages images = {depth, grey, other_grey, mask, other_mask, width, height};
    PatchResult found = {0.0, 0.0, 0.0, 0.0, 0.0};
    const int state = noise[k] < INFINITE
        ? compare_patch(images, normals, alpha, camera, pair, pixels[k], squared != 0, sizes, max_rise,
                        min_spread, lane, found)
        : PATCH_SKIPPED;
    if (lane != 0) return;
    const bool kept = state == PATCH_KEPT;
    states[k] = (unsigned char)state;
    errors[k] = kept ? found.error : 0.0;
    by_depth[k] = kept ? found.by_depth : 0.0;
#pragma unroll
    for (int c = 0; c < 3; ++c)
        by_normals[3 * k + c] = kept
            ? camera.v[c] * found.d0 + camera.v[3 + c] * found.d1 + camera.v[6 + c] * found.d2 : 0.0;
}

// Write the gradients of both terms on the images of the reference view; pixels with values that
// are not finite get none. `shares (2,)` are the terms' factors over their numbers of pixels.
extern "C" __global__ void __launch_bounds__(BLOCK) finish_pixels(
    int count, const int* pixels, const float* depth, const float* normals, const double* weights,
    const double* shares, const double* by_depth, const double* by_normals,
    const double* by_positions, const float* on_positions, const double* position_slopes,
    float* grad_depth, float* grad_normals) {
    const int64 k = (int64)blockIdx.x * BLOCK + threadIdx.x;
    if (k >= count) return;
    const int64 pixel = pixels[k];
    if (pixel < 0) return;
    const double photometric = shares[0] * weights[k], geometric = shares[1] * weights[k];
    double on_depth = photometric * by_depth[k];
#pragma unroll
    for (int axis = 0; axis < 2; ++axis)
        on_depth += (geometric * by_positions[2 * k + axis] + on_positions[2 * k + axis])
            * position_slopes[2 * k + axis];
    bool sound = fabs(on_depth) < INFINITE && fabsf(depth[pixel]) < INFINITE;
    double on_normal[3];
#pragma unroll
    for (int c = 0; c < 3; ++c) {
        on_normal[c] = photometric * by_normals[3 * k + c];
        sound = sound && fabs(on_normal[c]) < INFINITE && fabsf(normals[3 * pixel + c]) < INFINITE;
    }
    if (!sound) return;
    grad_depth[pixel] = (float)on_depth;
#pragma unroll
    for (int c = 0; c < 3; ++c) grad_normals[3 * pixel + c] = (float)on_normal[c];
}
