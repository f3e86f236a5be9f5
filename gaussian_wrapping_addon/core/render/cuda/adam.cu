// SPDX-License-Identifier: GPL-3.0-or-later
// Adam steps of the Gaussians that a view has seen, all tensors at once: the formulas and the
// columns of adam.py. One warp a Gaussian, so that a row's moments are read in one piece.

// Where a column of the moments lies in the tensors: its values and gradients.
struct AdamColumn {
    float* value;
    const float* gradient;
};

__device__ __forceinline__ AdamColumn adam_column(
    int64 i, int column, int sh_values, float* quats, float* orientation, float* means,
    float* opacity_logits, float* log_scales, float* sh, const float* g_quats,
    const float* g_orientation, const float* g_means, const float* g_opacity_logits,
    const float* g_log_scales, const float* g_sh) {
    if (column >= 16) {
        const int64 at = i * sh_values + column - 16;
        return {sh + at, g_sh + at};
    }
    if (column < 4) return {quats + 4 * i + column, g_quats + 4 * i + column};
    if (column < 8) return {orientation + 4 * i + column - 4, g_orientation + 4 * i + column - 4};
    if (column < 11) return {means + 3 * i + column - 8, g_means + 3 * i + column - 8};
    if (column < 12) return {opacity_logits + i, g_opacity_logits + i};
    return {log_scales + 3 * i + column - 12, g_log_scales + 3 * i + column - 12};
}

// `columns`: columns of the moments (16 and the harmonics'), `stepped` the first of them that no
// tensor has or that never had a gradient. Columns of negative rate keep values and moments.
extern "C" __global__ void __launch_bounds__(BLOCK) adam_rows(
    int count, int columns, int stepped, int sh_values, float* quats, float* orientation,
    float* means, float* opacity_logits, float* log_scales, float* sh, const float* g_quats,
    const float* g_orientation, const float* g_means, const float* g_opacity_logits,
    const float* g_log_scales, const float* g_sh, float* moments, int* steps,
    const float* corrections, int last_correction, const float* rates) {
    const int64 i = (int64)blockIdx.x * WARPS + (threadIdx.x >> 5);
    const int lane = threadIdx.x & 31;
    if (i >= count) return;
    const int step = min(steps[i] + 1, last_correction);
    bool seen = false;
    for (int column = lane; column < stepped; column += 32) {
        if (column == 15) continue; // belongs to no tensor
        const AdamColumn at = adam_column(
            i, column, sh_values, quats, orientation, means, opacity_logits, log_scales, sh, g_quats,
            g_orientation, g_means, g_opacity_logits, g_log_scales, g_sh);
        seen = seen || *at.gradient != 0.0f;
    }
    if (__ballot_sync(ALL_LANES, seen) == 0u) return; // also: every lane has read `steps`
    const float up = corrections[2 * step], down = corrections[2 * step + 1];
    if (lane == 0) steps[i] += 1;
    for (int column = lane; column < stepped; column += 32) {
        const float rate = rates[column];
        if (column == 15 || !(rate >= 0.0f)) continue;
        const AdamColumn at = adam_column(
            i, column, sh_values, quats, orientation, means, opacity_logits, log_scales, sh, g_quats,
            g_orientation, g_means, g_opacity_logits, g_log_scales, g_sh);
        const float g = *at.gradient;
        float* first = moments + 2 * i * columns + column;
        float* second = first + columns;
        const float m = __fadd_rn(__fmul_rn(ADAM_BETA1, *first), __fmul_rn(1.0f - ADAM_BETA1, g));
        const float v = __fadd_rn(
            __fmul_rn(ADAM_BETA2, *second), __fmul_rn(__fmul_rn(1.0f - ADAM_BETA2, g), g));
        *first = m;
        *second = v;
        const float size = __fadd_rn(__fmul_rn(sqrtf(v), down), ADAM_EPSILON);
        *at.value -= rate * up * m / size;
    }
}
