// SPDX-License-Identifier: GPL-3.0-or-later
// z-depth where the transmittance along each pixel's ray crosses 0.5
// (docs/method.md, sections 2.4 and 2.5).
//
// A warp solves its 8 x 4 pixels alone, traversing the tile's list for every Newton step: no lists
// per pixel, whose length has no bound, and no barrier. The masks of the blending skip those that
// none of its open pixels intersects; traversal ends at the last Gaussian that can contribute.

// Call visit(position, row) in blending order for the contributors of this lane's pixel, as far
// as the pixel's bit is set in `wanted`.
template <class Visit>
__device__ __forceinline__ void walk(
    const float4* params, const int* gaussian_ids, const unsigned* masks, int64 begin, int64 end,
    int warp, int lane, unsigned wanted, Visit visit) {
    for (int64 first = begin; first < end; first += 32) {
        const bool listed = first + lane < end;
        const unsigned mask = listed ? masks[(first + lane) * WARPS + warp] & wanted : 0u;
        const int id = listed ? gaussian_ids[first + lane] : 0;
        unsigned pairs = __ballot_sync(ALL_LANES, mask != 0u);
        while (pairs != 0u) {
            const int j = __ffs(pairs) - 1;
            pairs &= pairs - 1u;
            const unsigned seen = __shfl_sync(ALL_LANES, mask, j);
            const int64 i = __shfl_sync(ALL_LANES, id, j);
            if (seen >> lane & 1u) visit(first + j, params + i * ROW_QUADS);
        }
    }
}

extern "C" __global__ void __launch_bounds__(BLOCK) isosurface_tiles(
    const float4* params, const int64* start, const int* gaussian_ids, const unsigned* masks,
    int tiles_x, int first_row, int width, int height, float limit, const float* alpha_image,
    float* depth_image, float* slope_image) {
    const int thread = threadIdx.x, warp = thread >> 5, lane = thread & 31;
    const int x = (int)(blockIdx.x % tiles_x) * TILE + pixel_column(thread);
    const int y = (first_row + (int)(blockIdx.x / tiles_x)) * TILE + pixel_row(thread);
    const bool inside = x < width && y < height;
    const int64 pixel = (int64)y * width + x;
    const float at_x = x + 0.5f, at_y = y + 0.5f;
    const int64 begin = start[blockIdx.x];
    int64 end = start[blockIdx.x + 1];
    const float final = inside ? 1.0f - alpha_image[pixel] : 1.0f;
    bool open = final <= limit && final < ISO_LEVEL;
    float t = 0.0f, slope = 1.0f;

    // First traversal: the Gaussian at which the blending crosses 0.5, and the bracket.
    float through = 1.0f, high = 0.0f, nearest = FARTHEST, sharpest = 0.0f;
    float cross_before = 0.0f, cross_alpha = 0.0f, cross_peak = 0.0f, cross_sharpness = TINY;
    int needed = 0; // intersections from `begin` on that can contribute
    const unsigned candidates = __ballot_sync(ALL_LANES, open);
    walk(params, gaussian_ids, masks, begin, end, warp, lane, candidates, [&](int64 at, const float4* row) {
        const float4 b = row[1], c = row[2];
        const Hit hit = evaluate(row[0], b, c, at_x, at_y);
        const float peak = peak_depth(hit, b, c.z);
        const float alpha = fminf(hit.raw, ALPHA_MAX);
        const float sharpness = row[3].x * hit.den;
        const float front = c.z - FRONT_SIGMAS * row[5].z;
        const float before = through, beyond = fmaxf(peak - high, 0.0f);
        through = fmaf(-alpha, through, through);
        // Behind the bracket a Gaussian contributes only if its density reaches the bracket's end.
        if (before > ISO_LEVEL || sharpness * beyond * beyond < NEGLIGIBLE)
            sharpest = fmaxf(sharpest, sharpness);
        nearest = fminf(nearest, front);
        if (before > ISO_LEVEL) {
            high = fmaxf(high, peak);
            if (through <= ISO_LEVEL)
                cross_before = before, cross_alpha = alpha, cross_peak = peak, cross_sharpness = sharpness;
        }
        if (before > ISO_LEVEL || front < high) needed = (int)(at - begin) + 1;
    });
    for (int offset = 16; offset > 0; offset >>= 1)
        needed = max(needed, __shfl_xor_sync(ALL_LANES, needed, offset));
    end = begin + needed;
    open = open && cross_before > 0.0f;
    float low = fmaxf(nearest, 0.0f);
    sharpest = sqrtf(fmaxf(sharpest, TINY));
    const float alone = sqrtf(fmaxf(cross_sharpness, TINY));
    if (open) {
        // That Gaussian alone reaches T = 0.5 where exp(-s d^2 / 2) = ratio.
        const float ratio = (cross_before - ISO_LEVEL) / fmaxf(cross_alpha * cross_before, TINY);
        const float ahead = -2.0f * logf(fminf(fmaxf(ratio, TINY), 1.0f)) / fmaxf(cross_sharpness, TINY);
        t = cross_peak - sqrtf(fmaxf(ahead, 0.0f));
        if (!(t > low && t < high)) t = 0.5f * (low + high);
    }

    // T and the first two derivatives of -log T at the depth `where` of every pixel in `wanted`.
    float product = 1.0f, steep = 0.0f, growth = 0.0f;
    auto transmit = [&](float where, unsigned wanted) {
        product = 1.0f;
        steep = growth = 0.0f;
        walk(params, gaussian_ids, masks, begin, end, warp, lane, wanted, [&](int64, const float4* row) {
            const float4 b = row[1], c = row[2];
            const Hit hit = evaluate(row[0], b, c, at_x, at_y);
            const float ahead = fmaxf(peak_depth(hit, b, c.z) - where, 0.0f);
            const float sharpness = ahead > 0.0f ? row[3].x * hit.den : 0.0f;
            const float pull = sharpness * ahead, fall = 0.5f * pull * ahead;
            if (!(fall < FALL_END)) return; // no contribution; the square below could overflow
            const float density = fminf(hit.raw * __expf(-fall), ALPHA_MAX);
            const float keep = 1.0f - density;
            const float odds = __fdividef(density, keep);
            product *= keep;
            steep = fmaf(odds, pull, steep);
            growth = fmaf(odds, __fdividef(pull * pull, keep) - sharpness, growth);
        });
    };
    // Some Gaussian may reach the camera: a crossing needs T > 0.5 at depth 0.
    const unsigned inner = __ballot_sync(ALL_LANES, open && nearest <= 0.0f);
    if (inner != 0u) {
        transmit(0.0f, inner);
        if ((inner >> lane & 1u) && !(product > ISO_LEVEL)) open = false;
    }
    if (!open) t = 0.0f;
    for (int steps = 0; steps < SOLVER_MAX_STEPS; ++steps) {
        const unsigned wanted = __ballot_sync(ALL_LANES, open);
        if (wanted == 0u) break;
        transmit(t, wanted);
        if (!open) continue;
        const float excess = logf(fmaxf(product, TINY) / ISO_LEVEL);
        if (excess > 0.0f) low = t;
        else high = t;
        slope = steep;
        // A Newton step with Halley's correction, within a factor of two.
        const float turns = 1.0f / fmaxf(slope, SOLVER_LEAST_SLOPE);
        const float newton = excess * turns;
        const float step = newton / fminf(fmaxf(1.0f + 0.5f * newton * growth * turns, 0.5f), 2.0f);
        const float sigmas = fabsf(step) * sharpest;
        if (sigmas < SOLVER_STEP_SIGMAS || fabsf(excess) <= SOLVER_LEVEL_MARGIN
            || high - low <= SOLVER_BRACKET_SHARE * high) {
            const bool lost = fabsf(excess) > SOLVER_LEVEL_FAR && slope < SOLVER_FLAT * alone;
            // A longer step would leave the depth at which the slope is known.
            if (sigmas < SOLVER_POLISH_SIGMAS) {
                const float moved = fminf(fmaxf(t + step, low), high);
                slope = fmaf(growth, moved - t, slope);
                t = moved;
            }
            // A layer thinner than the depth's rounding error has no reliable gradient.
            if (lost) slope = 2.0f * alone;
            open = false;
            continue;
        }
        // Long enough to close the bracket; a steep layer may end before the level.
        const float least = SOLVER_LEAST_SHARE * t;
        const float moved = t + (fabsf(step) > least ? step : copysignf(least, excess));
        // After some Newton steps every second one is a bisection, which bounds their number.
        const bool bisect = steps >= SOLVER_NEWTON_STEPS && (steps & 1) != 0;
        t = moved > low && moved < high && !bisect ? moved : 0.5f * (low + high);
    }
    if (!inside) return;
    depth_image[pixel] = t;
    slope_image[pixel] = t > 0.0f ? fmaxf(slope, SLOPE_FLOOR * alone) : 1.0f;
}
