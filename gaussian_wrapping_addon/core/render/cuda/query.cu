// SPDX-License-Identifier: GPL-3.0-or-later
// Isosurface depth of a view at sub-pixel positions, and its gradient: definitions of
// depth_query.py, formulas of isosurface.cu and depth_query.py.
//
// A tile's list holds the Gaussians that reach the rectangle around the tile's points, not its
// pixel centres; with few points a tile it is hardly longer than the list of contributors.

// -- projection and lists -------------------------------------------------------------------------

// Scale a row from a screen `scale` times as fine to pixels, see query_kernels.py; return false where
// rendering would overflow float32.
__device__ __forceinline__ bool shrink_row(
    const CameraValues& camera, double scale, float* row, float* box, float* skew) {
    const double u = row[0] / scale, v = row[1] / scale, square = scale * scale;
    const double reach_x = fmax(fabs(u), fabs(camera.v[19] - u)) + TILE;
    const double reach_y = fmax(fabs(v), fabs(camera.v[20] - v)) + TILE;
    const double xx = reach_x * reach_x, xy = reach_x * reach_y, yy = reach_y * reach_y;
    const double qa = row[2] * square, qb = row[3] * square, qc = row[4] * square;
    const double px = row[5] * scale, py = row[6] * scale;
    const double r = row[7] * square, s = row[8] * square, t = row[9] * square;
    const double den = 1.0 + 2.0 * (fabs(px) * reach_x + fabs(py) * reach_y) + r * xx + fabs(s) * xy + t * yy;
    if (!(reach_x <= FINITE_OFFSET_PX && reach_y <= FINITE_OFFSET_PX
          && qa * xx + fabs(qb) * xy + qc * yy <= FINITE_NUM && den <= FINITE_DEN
          && row[12] * den * row[10] <= FINITE_PULL))
        return false;
    row[0] = (float)u, row[1] = (float)v;
    row[2] = (float)qa, row[3] = (float)qb, row[4] = (float)qc;
    row[5] = (float)px, row[6] = (float)py;
    row[7] = (float)r, row[8] = (float)s, row[9] = (float)t;
    *skew = (float)(*skew / scale);
#pragma unroll
    for (int side = 0; side < 4; ++side) {
        // Clipped, far outside the image: no longer the box of the ellipse.
        if (fabsf(box[side]) > BOX_END) *skew = INFINITE;
        box[side] = (float)(box[side] / scale);
    }
    return true;
}

__device__ __forceinline__ bool fits_float32(const float* row, const float* box, float depth, float skew) {
    bool fits = depth < FLOAT32_LARGE && (skew == INFINITE || fabsf(skew) < FLOAT32_LARGE);
#pragma unroll
    for (int column = 0; column < 24; ++column) fits = fits && fabsf(row[column]) < FLOAT32_LARGE;
#pragma unroll
    for (int side = 0; side < 4; ++side) fits = fits && fabsf(box[side]) < FLOAT32_LARGE;
    return fits;
}

// As project_gaussians, without colours and learned normals, on a screen `scale` times as fine, so
// that Gaussians between pixel centres are kept; in pixels of `camera`. Those a hundred image sizes
// off the image, beyond the finer screen's range, are projected onto the image itself.
extern "C" __global__ void __launch_bounds__(BLOCK) project_finely(
    int count, const float* means, const float* log_scales, const float* quats,
    const float* opacity_logits, const float* sh, int coefficients, int degree,
    const float* orientation, const float* filter_3d, CameraValues camera, int scale,
    float4* params, float4* boxes, unsigned char* visible, float* depths, float* skews) {
    const int64 i = (int64)blockIdx.x * BLOCK + threadIdx.x;
    if (i >= count) return;
    float row[24];
#pragma unroll
    for (int column = 0; column < 24; ++column) row[column] = 0.0f;
    float box[4] = {0.0f, 0.0f, -1.0f, -1.0f};
    float depth = INFINITE, skew = 0.0f;
    const double m[3] = {means[3 * i], means[3 * i + 1], means[3 * i + 2]};
    double local[3];
    to_camera(camera, m, local);
    bool given = local[2] > camera.v[21], seen = false;
    // Rendering hides what has no finite colour or normal.
#pragma unroll
    for (int channel = 0; channel < 3; ++channel)
        given = given && 0.5 + SH_C0 * (double)sh[i * coefficients * 3 + channel] <= FINITE_COLOR
            && fabs((double)orientation[4 * i + channel]) <= FLOAT32_MAX;
    given = given && orientation[4 * i + 3] == orientation[4 * i + 3];
    if (given) {
        double rotation[9], axes[9], variances[3];
        rotation_from_quat(quats + 4 * i, rotation);
        camera_axes(camera, rotation, axes);
        const double filter_sq = (double)filter_3d[i] * (double)filter_3d[i];
        double kept = 1.0;
#pragma unroll
        for (int k = 0; k < 3; ++k) {
            const double raw = exp(2.0 * (double)log_scales[3 * i + k]);
            variances[k] = raw + filter_sq;
            kept *= raw / variances[k];
        }
        const double opacity = sqrt(kept) / (1.0 + exp(-(double)opacity_logits[i]));
        const double aside = fmax(
            fabs(local[0] / local[2] * camera.v[15] + camera.v[17]),
            fabs(local[1] / local[2] * camera.v[16] + camera.v[18]));
        const bool distant = local[2] > 0.0
            && aside > FINITE_OFFSET_PX / scale - fmax(camera.v[19], camera.v[20]) - TILE;
        const int finer = distant ? 1 : scale;
        CameraValues screen = camera;
#pragma unroll
        for (int value = 15; value < 21; ++value) screen.v[value] = camera.v[value] * finer;
        seen = project_shape(local, axes, variances, opacity, screen, row, box, &depth, &skew)
            && fits_float32(row, box, depth, skew);
        if (seen && finer > 1) seen = shrink_row(camera, finer, row, box, &skew);
    }
    if (!seen) {
#pragma unroll
        for (int column = 0; column < 24; ++column) row[column] = 0.0f;
        box[0] = box[1] = 0.0f;
        box[2] = box[3] = -1.0f;
        depth = INFINITE;
        skew = 0.0f;
    }
#pragma unroll
    for (int quad = 0; quad < ROW_QUADS; ++quad)
        params[i * ROW_QUADS + quad]
            = make_float4(row[4 * quad], row[4 * quad + 1], row[4 * quad + 2], row[4 * quad + 3]);
    boxes[i] = make_float4(box[0], box[1], box[2], box[3]);
    visible[i] = seen;
    depths[i] = depth;
    skews[i] = skew;
}

// The rectangle around the points of each tile; empty (x0 > x1) without points.
extern "C" __global__ void __launch_bounds__(BLOCK) bound_points(
    int tiles, const int64* point_start, const float* positions, float4* areas) {
    const int tile = blockIdx.x * BLOCK + threadIdx.x;
    if (tile >= tiles) return;
    float4 area = make_float4(FARTHEST, FARTHEST, -FARTHEST, -FARTHEST);
    for (int64 p = point_start[tile]; p < point_start[tile + 1]; ++p) {
        const float x = positions[2 * p], y = positions[2 * p + 1];
        area = make_float4(fminf(area.x, x), fminf(area.y, y), fmaxf(area.z, x), fmaxf(area.w, y));
    }
    areas[tile] = area;
}

// An ellipse prepared for many tests in float32, as in query_kernels.py. At height t (in half heights)
// it spans skew t +- across sqrt(1 - t^2).
struct Ellipse {
    float center_x, center_y, skew, extreme, inverse, across, margin;
};

__device__ __forceinline__ Ellipse prepare_ellipse(float4 box, float skew_px) {
    // Where there is no ellipse that could exclude a tile, the box alone decides.
    Ellipse e = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, FARTHEST, 0.0f};
    const double half_x = 0.5 * ((double)box.z - (double)box.x);
    const double half_y = 0.5 * ((double)box.w - (double)box.y);
    if (!(fabsf(skew_px) < FLOAT32_LARGE) || !(half_x > 0.0 && half_y > 0.0)) return e;
    const double center_x = 0.5 * ((double)box.z + (double)box.x), skew = skew_px;
    e.center_x = (float)center_x;
    e.center_y = (float)(0.5 * ((double)box.w + (double)box.y));
    e.skew = skew_px;
    e.extreme = skew_px / (float)half_x;
    e.inverse = 1.0f / (float)half_y;
    e.across = sqrtf((float)fmax(half_x * half_x * (1.0 + SHARE_MARGIN) - skew * skew, 0.0));
    e.margin = (float)(STRIP_MARGIN + FLOAT_MARGIN * (half_x + fabs(center_x)));
    return e;
}

// Whether the ellipse's x extent within the rows of a rectangle reaches that rectangle.
__device__ __forceinline__ bool reaches(const Ellipse& e, float4 area) {
    const float first = fmaxf((area.y - (float)STRIP_MARGIN - e.center_y) * e.inverse - FLOAT_MARGIN, -1.0f);
    const float last = fminf((area.w + (float)STRIP_MARGIN - e.center_y) * e.inverse + FLOAT_MARGIN, 1.0f);
    float t = fminf(fmaxf(e.extreme, first), last);
    const float right = e.skew * t + e.across * sqrtf(fmaxf(1.0f - t * t, 0.0f));
    t = fminf(fmaxf(-e.extreme, first), last);
    const float left = e.skew * t - e.across * sqrtf(fmaxf(1.0f - t * t, 0.0f));
    return first <= last && e.center_x + right + e.margin >= area.x && e.center_x + left - e.margin <= area.z;
}

__device__ __forceinline__ int tile_index(double place, int tiles) {
    return (int)fmin(fmax(place / TILE, 0.0), tiles - 1.0); // clamped before it could overflow
}

// Call visit(tile) for the tiles with points whose rectangle a Gaussian's ellipse reaches.
template <class Visit>
__device__ __forceinline__ void reached_tiles(
    float4 box, float skew, const float4* areas, int tiles_x, int tiles_y, Visit visit) {
    const Ellipse ellipse = prepare_ellipse(box, skew);
    const float top = box.y - (float)STRIP_MARGIN, bottom = box.w + (float)STRIP_MARGIN;
    const int last_row = tile_index(box.w, tiles_y), last_column = tile_index(box.z, tiles_x);
    for (int row = tile_index(box.y, tiles_y); row <= last_row; ++row)
        for (int column = tile_index(box.x, tiles_x); column <= last_column; ++column) {
            const int tile = row * tiles_x + column;
            const float4 area = areas[tile];
            if (area.x <= area.z && top <= area.w && bottom >= area.y && reaches(ellipse, area))
                visit(tile);
        }
}

extern "C" __global__ void __launch_bounds__(BLOCK) count_areas(
    int count, const float4* boxes, const float* skews, const unsigned char* visible,
    const float4* areas, int tiles_x, int tiles_y, int64* pair_counts) {
    const int i = blockIdx.x * BLOCK + threadIdx.x;
    if (i >= count) return;
    int64 pairs = 0;
    if (visible[i])
        reached_tiles(boxes[i], skews[i], areas, tiles_x, tiles_y, [&](int) { ++pairs; });
    pair_counts[i] = pairs;
}

// As list_pairs: the thread of rank k lists the tiles of Gaussian order[k].
extern "C" __global__ void __launch_bounds__(BLOCK) list_areas(
    int count, const int64* order, const int64* rank_offsets, const int64* pair_offsets,
    const float4* boxes, const float* skews, const float4* areas, int tiles_x, int tiles_y,
    int* tiles, int* gaussian_ids, int* pair_slots) {
    const int k = blockIdx.x * BLOCK + threadIdx.x;
    if (k >= count) return;
    int64 place = rank_offsets[k];
    if (place == rank_offsets[k + 1]) return;
    const int64 i = order[k];
    int slot = (int)pair_offsets[i];
    reached_tiles(boxes[i], skews[i], areas, tiles_x, tiles_y, [&](int tile) {
        tiles[place] = tile;
        gaussian_ids[place] = (int)i;
        pair_slots[place] = slot++;
        ++place;
    });
}

// -- depths ---------------------------------------------------------------------------------------

__device__ __forceinline__ float warp_product(float value) {
    for (int offset = 16; offset > 0; offset >>= 1)
        value *= __shfl_xor_sync(ALL_LANES, value, offset);
    return value;
}

// One warp per point, points sorted by tile; its lanes take 32 Gaussians of the list at a time.
// Writes the depth (0 where there is none), the floored slope of -log T there, and how many
// Gaussians of the list, from its beginning, can contribute to T at that depth.
//
// Sums over lanes are butterflies: all lanes get the same bits and take the same branches.
extern "C" __global__ void __launch_bounds__(BLOCK) solve_points(
    int count, const float4* params, const int64* start, const int* gaussian_ids, int tiles,
    const int* point_tiles, const float* positions, float limit, float* values, float* slopes,
    int* stops) {
    const int lane = threadIdx.x & 31;
    const int64 p = (int64)blockIdx.x * WARPS + (threadIdx.x >> 5);
    if (p >= count) return;
    const int tile = point_tiles[p];
    const bool listed = tile < tiles; // false outside the image
    const int64 begin = listed ? start[tile] : 0;
    int64 end = listed ? start[tile + 1] : 0;
    const float at_x = positions[2 * p], at_y = positions[2 * p + 1];

    // First traversal: the Gaussian at which the blending crosses 0.5, and the bracket.
    float through = 1.0f, high = 0.0f, nearest = FARTHEST, sharpest = 0.0f;
    float cross_before = 0.0f, cross_alpha = 0.0f, cross_peak = 0.0f, cross_sharpness = TINY;
    int needed = 0;
    for (int64 first = begin; first < end && through >= TRANSMITTANCE_MIN; first += 32) {
        float alpha = 0.0f, peak = 0.0f, sharpness = 0.0f, front = FARTHEST;
        if (first + lane < end) {
            const float4* row = params + (int64)gaussian_ids[first + lane] * ROW_QUADS;
            const float4 b = row[1], c = row[2];
            const Hit hit = evaluate(row[0], b, c, at_x, at_y);
            if (hit.raw >= ALPHA_MIN) {
                alpha = fminf(hit.raw, ALPHA_MAX);
                peak = peak_depth(hit, b, c.z);
                sharpness = row[3].x * hit.den;
                front = c.z - FRONT_SIGMAS * row[5].z;
            }
        }
        // One after the other, as pixels are blended: a prefix product over lanes would be rounded
        // otherwise and could rise from one lane to the next.
        unsigned pairs = __ballot_sync(ALL_LANES, alpha > 0.0f);
        float before = 0.0f; // stays 0 where nothing is contributed
        while (pairs != 0u && through >= TRANSMITTANCE_MIN) {
            const int j = __ffs(pairs) - 1;
            pairs &= pairs - 1u;
            const float blended = __shfl_sync(ALL_LANES, alpha, j);
            if (lane == j) before = through;
            through = fmaf(-blended, through, through);
        }
        const bool ahead = before > ISO_LEVEL;
        high = fmaxf(high, warp_max(ahead ? peak : 0.0f));
        const unsigned crossing
            = __ballot_sync(ALL_LANES, ahead && fmaf(-alpha, before, before) <= ISO_LEVEL);
        if (crossing != 0u) {
            const int j = __ffs(crossing) - 1;
            cross_before = __shfl_sync(ALL_LANES, before, j);
            cross_alpha = __shfl_sync(ALL_LANES, alpha, j);
            cross_peak = __shfl_sync(ALL_LANES, peak, j);
            cross_sharpness = __shfl_sync(ALL_LANES, sharpness, j);
        }
        if (before > 0.0f) {
            // Behind the bracket a Gaussian contributes only if its density reaches the end of it.
            const float beyond = fmaxf(peak - high, 0.0f);
            if (ahead || sharpness * beyond * beyond < NEGLIGIBLE) sharpest = fmaxf(sharpest, sharpness);
            nearest = fminf(nearest, front);
            if (ahead || front < high) needed = (int)(first - begin) + lane + 1;
        }
    }
    for (int offset = 16; offset > 0; offset >>= 1)
        needed = max(needed, __shfl_xor_sync(ALL_LANES, needed, offset));
    nearest = -warp_max(-nearest);
    sharpest = sqrtf(fmaxf(warp_max(sharpest), TINY));
    end = begin + needed;
    bool open = cross_before > 0.0f && through <= limit && through < ISO_LEVEL;
    const float alone = sqrtf(fmaxf(cross_sharpness, TINY));

    // T and the first two derivatives of -log T at a depth.
    float product = 1.0f, steep = 0.0f, growth = 0.0f;
    auto transmit = [&](float where) {
        product = 1.0f;
        steep = growth = 0.0f;
        for (int64 at = begin + lane; at < end; at += 32) {
            const float4* row = params + (int64)gaussian_ids[at] * ROW_QUADS;
            const float4 b = row[1], c = row[2];
            const Hit hit = evaluate(row[0], b, c, at_x, at_y);
            const float ahead = fmaxf(peak_depth(hit, b, c.z) - where, 0.0f);
            const float sharpness = ahead > 0.0f ? row[3].x * hit.den : 0.0f;
            const float pull = sharpness * ahead, fall = 0.5f * pull * ahead;
            if (!(hit.raw >= ALPHA_MIN && fall < FALL_END)) continue;
            const float density = fminf(hit.raw * __expf(-fall), ALPHA_MAX);
            const float keep = 1.0f - density;
            const float odds = __fdividef(density, keep);
            product *= keep;
            steep = fmaf(odds, pull, steep);
            growth = fmaf(odds, __fdividef(pull * pull, keep) - sharpness, growth);
        }
        product = warp_product(product);
        steep = warp_sum(steep);
        growth = warp_sum(growth);
    };
    // Some Gaussian may reach the camera: a crossing needs T > 0.5 at depth 0.
    if (open && nearest <= 0.0f) {
        transmit(0.0f);
        open = product > ISO_LEVEL;
    }
    float t = 0.0f, slope = 1.0f;
    if (open) {
        // The Gaussian at the crossing alone reaches T = 0.5 where exp(-s d^2 / 2) = ratio.
        const float ratio = (cross_before - ISO_LEVEL) / fmaxf(cross_alpha * cross_before, TINY);
        const float ahead = -2.0f * logf(fminf(fmaxf(ratio, TINY), 1.0f)) / fmaxf(cross_sharpness, TINY);
        float low = fmaxf(nearest, 0.0f);
        t = cross_peak - sqrtf(fmaxf(ahead, 0.0f));
        if (!(t > low && t < high)) t = 0.5f * (low + high);
        // Steps as in isosurface_tiles.
        for (int steps = 0; steps < SOLVER_MAX_STEPS; ++steps) {
            transmit(t);
            const float excess = logf(fmaxf(product, TINY) / ISO_LEVEL);
            if (excess > 0.0f) low = t;
            else high = t;
            slope = steep;
            const float turns = 1.0f / fmaxf(slope, SOLVER_LEAST_SLOPE);
            const float newton = excess * turns;
            const float step = newton / fminf(fmaxf(1.0f + 0.5f * newton * growth * turns, 0.5f), 2.0f);
            const float sigmas = fabsf(step) * sharpest;
            if (sigmas < SOLVER_STEP_SIGMAS || fabsf(excess) <= SOLVER_LEVEL_MARGIN
                || high - low <= SOLVER_BRACKET_SHARE * high) {
                const bool lost = fabsf(excess) > SOLVER_LEVEL_FAR && slope < SOLVER_FLAT * alone;
                if (sigmas < SOLVER_POLISH_SIGMAS) {
                    const float moved = fminf(fmaxf(t + step, low), high);
                    slope = fmaf(growth, moved - t, slope);
                    t = moved;
                }
                if (lost) slope = 2.0f * alone;
                break;
            }
            const float least = SOLVER_LEAST_SHARE * t;
            const float moved = t + (fabsf(step) > least ? step : copysignf(least, excess));
            const bool bisect = steps >= SOLVER_NEWTON_STEPS && (steps & 1) != 0;
            t = moved > low && moved < high && !bisect ? moved : 0.5f * (low + high);
        }
    }
    if (lane != 0) return;
    values[p] = t;
    slopes[p] = t > 0.0f ? fmaxf(slope, SLOPE_FLOOR * alone) : 1.0f;
    stops[p] = needed;
}

// -- gradients ------------------------------------------------------------------------------------

// Gradient of weight * log T(t) on one Gaussian's values on the ray.
struct LogPull {
    float num, den, shift, log, peak, sharpness; // on each of these
    float x, y;                                  // on the position
    Hit hit;
};

__device__ __forceinline__ bool pull_log(
    const float4 a, const float4 b, const float4 c, float a0, float x, float y, float t,
    float weight, LogPull& g) {
    g.hit = evaluate(a, b, c, x, y);
    if (!(g.hit.raw >= ALPHA_MIN)) return false;
    const float dx = g.hit.dx, dy = g.hit.dy, inverse = g.hit.inverse;
    const float peak = peak_depth(g.hit, b, c.z);
    const float ahead = fmaxf(peak - t, 0.0f);
    const float sharpness = a0 * g.hit.den;
    const float density = g.hit.raw * __expf(-0.5f * sharpness * ahead * ahead);
    if (!(density < ALPHA_MAX)) return false;
    g.log = -weight * __fdividef(density, 1.0f - density);
    const float distance = -0.5f * g.log;
    const float on_peak = -g.log * sharpness * ahead;
    const float on_sharpness = distance * ahead * ahead;
    g.num = distance * inverse;
    g.den = a0 * on_sharpness - (g.num * g.hit.distance + on_peak * peak * inverse);
    g.shift = on_peak * inverse * c.z + 2.0f * g.den;
    g.peak = on_peak * peak;
    g.sharpness = on_sharpness * g.hit.den;
    g.x = g.num * (2.0f * a.z * dx + a.w * dy) + g.den * (2.0f * b.w * dx + c.x * dy) + g.shift * b.y;
    g.y = g.num * (2.0f * b.x * dy + a.w * dx) + g.den * (2.0f * c.y * dy + c.x * dx) + g.shift * b.z;
    return true;
}

struct QueryShared {
    float x[BLOCK], y[BLOCK], t[BLOCK], weight[BLOCK];
    int stop[BLOCK];
};

// One block per tile, one thread per Gaussian of its list, which sums over the tile's points in
// their order and writes the intersection's row.
extern "C" __global__ void __launch_bounds__(BLOCK) query_gradients(
    const float4* params, const int64* start, const int* gaussian_ids, const int* pair_slots,
    const int64* point_start, const float* positions, const float* depths, const float* weights,
    const int* stops, float4* pairs) {
    __shared__ QueryShared shared;
    const int thread = threadIdx.x;
    const int64 begin = start[blockIdx.x], end = start[blockIdx.x + 1];
    const int64 from = point_start[blockIdx.x], to = point_start[blockIdx.x + 1];
    for (int64 first = begin; first < end; first += BLOCK) {
        const bool listed = first + thread < end;
        const int place = (int)(first - begin) + thread;
        const float4* row = params + (int64)gaussian_ids[listed ? first + thread : begin] * ROW_QUADS;
        const float4 a = row[0], b = row[1], c = row[2];
        const float a0 = row[3].x;
        float v[13];
#pragma unroll
        for (int column = 0; column < 13; ++column) v[column] = 0.0f;
        for (int64 batch = from; batch < to; batch += BLOCK) {
            const int points = (int)(to - batch < BLOCK ? to - batch : BLOCK);
            __syncthreads();
            if (thread < points) {
                const int64 p = batch + thread;
                shared.x[thread] = positions[2 * p];
                shared.y[thread] = positions[2 * p + 1];
                shared.t[thread] = depths[p];
                shared.weight[thread] = weights[p];
                shared.stop[thread] = weights[p] != 0.0f ? stops[p] : 0;
            }
            __syncthreads();
            for (int k = 0; listed && k < points; ++k) {
                LogPull g;
                if (place >= shared.stop[k]
                    || !pull_log(a, b, c, a0, shared.x[k], shared.y[k], shared.t[k], shared.weight[k], g))
                    continue;
                const float dx = g.hit.dx, dy = g.hit.dy;
                v[0] -= g.x;
                v[1] -= g.y;
                v[2] += g.num * dx * dx;
                v[3] += g.num * dx * dy;
                v[4] += g.num * dy * dy;
                v[5] += g.shift * dx;
                v[6] += g.shift * dy;
                v[7] += g.den * dx * dx;
                v[8] += g.den * dx * dy;
                v[9] += g.den * dy * dy;
                v[10] += g.peak;
                v[11] += g.log;
                v[12] += g.sharpness;
            }
        }
        if (!listed) continue;
        float4* out = pairs + (int64)pair_slots[first + thread] * ROW_QUADS;
        out[0] = make_float4(v[0], v[1], v[2], v[3]);
        out[1] = make_float4(v[4], v[5], v[6], v[7]);
        out[2] = make_float4(v[8], v[9], v[10] / c.z, v[11] / c.w);
        out[3] = make_float4(v[12], 0.0f, 0.0f, 0.0f);
        out[4] = out[5] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    }
}

// One warp per point: the gradient on its position.
extern "C" __global__ void __launch_bounds__(BLOCK) position_gradients(
    int count, const float4* params, const int64* start, const int* gaussian_ids, int tiles,
    const int* point_tiles, const float* positions, const float* depths, const float* weights,
    const int* stops, float* grad_positions) {
    const int lane = threadIdx.x & 31;
    const int64 p = (int64)blockIdx.x * WARPS + (threadIdx.x >> 5);
    if (p >= count) return;
    float sum_x = 0.0f, sum_y = 0.0f;
    const int tile = point_tiles[p];
    const float weight = weights[p];
    if (tile < tiles && weight != 0.0f) {
        const float x = positions[2 * p], y = positions[2 * p + 1], t = depths[p];
        const int64 end = start[tile] + stops[p];
        for (int64 at = start[tile] + lane; at < end; at += 32) {
            const float4* row = params + (int64)gaussian_ids[at] * ROW_QUADS;
            LogPull g;
            if (!pull_log(row[0], row[1], row[2], row[3].x, x, y, t, weight, g)) continue;
            sum_x += g.x;
            sum_y += g.y;
        }
    }
    sum_x = warp_sum(sum_x);
    sum_y = warp_sum(sum_y);
    if (lane != 0) return;
    grad_positions[2 * p] = sum_x;
    grad_positions[2 * p + 1] = sum_y;
}
