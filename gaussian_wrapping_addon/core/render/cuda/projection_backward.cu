// SPDX-License-Identifier: GPL-3.0-or-later
// Gradient of the projection, one thread per Gaussian, in float64: the formulas of
// projection.py, where they are derived. Column 22 (a bound) carries no gradient.

// From the gradient on one row of params to axes, effective log scales and mean, camera frame.
__device__ __forceinline__ void shape_gradient(
    const double* local, const double* variances, const CameraValues& camera, const double* axes,
    const float* grad, double* grad_axes, double* grad_logs, double* grad_mean) {
    const double fx = camera.v[15], fy = camera.v[16];
    const double z = local[2], u = local[0] / z, v = local[1] / z, zz = z * z;
    const ShapeSums s = shape_sums(axes, variances, u, v);
    const double ia = 1.0 / s.a0;
    double g_u = grad[0] * fx, g_v = grad[1] * fy, g_z = grad[10];
    const double scale_xx = ia / (fx * fx), scale_xy = ia / (fx * fy), scale_yy = ia / (fy * fy);
    const double g_fyy = grad[2] * zz * scale_xx;
    const double g_fxy = -2.0 * grad[3] * zz * scale_xy;
    const double g_fxx = grad[4] * zz * scale_yy;
    const double conic = g_fyy * s.fyy + g_fxy * s.fxy + g_fxx * s.fxx;
    g_z += 2.0 * conic / z;
    double g_hx = grad[5] * ia / fx, g_hy = grad[6] * ia / fy, g_hz = 0.0;
    const double g_bxx = grad[7] * scale_xx, g_bxy = 2.0 * grad[8] * scale_xy;
    const double g_byy = grad[9] * scale_yy;
    const double quotients = conic + g_hx * s.hx + g_hy * s.hy + g_bxx * s.bxx + g_bxy * s.bxy
        + g_byy * s.byy;
    const double g_a0 = grad[12] - quotients * ia;
    const double length = sqrt(s.hx * s.hx + s.hy * s.hy + s.hz * s.hz);
    const double nx = -s.hx / length, ny = -s.hy / length, nz = -s.hz / length;
    const double gx = camera.v[0] * grad[19] + camera.v[1] * grad[20] + camera.v[2] * grad[21];
    const double gy = camera.v[3] * grad[19] + camera.v[4] * grad[20] + camera.v[5] * grad[21];
    const double gz = camera.v[6] * grad[19] + camera.v[7] * grad[20] + camera.v[8] * grad[21];
    const double along = gx * nx + gy * ny + gz * nz;
    g_hx -= (gx - along * nx) / length;
    g_hy -= (gy - along * ny) / length;
    g_hz -= (gz - along * nz) / length;
    grad_logs[0] = grad_logs[1] = grad_logs[2] = 0.0;
#pragma unroll
    for (int k = 0; k < 3; ++k) {
        const double r0 = axes[k], r1 = axes[3 + k], r2 = axes[6 + k];
        const double weight = 1.0 / variances[k];
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        const double others = 1.0 / (variances[i] * variances[j]);
        const double e = r0 * u + r1 * v + r2;
        const double f0 = r0 - u * r2, f1 = r1 - v * r2;
        const double h_dot = g_hx * r0 + g_hy * r1 + g_hz * r2;
        const double g_e = weight * (h_dot + 2.0 * e * g_a0);
        const double g_f0 = others * (2.0 * f0 * g_fxx + f1 * g_fxy);
        const double g_f1 = others * (f0 * g_fxy + 2.0 * f1 * g_fyy);
        grad_axes[k] = weight * (e * g_hx + 2.0 * r0 * g_bxx + r1 * g_bxy) + g_f0 + u * g_e;
        grad_axes[3 + k] = weight * (e * g_hy + r0 * g_bxy + 2.0 * r1 * g_byy) + g_f1 + v * g_e;
        grad_axes[6 + k] = weight * e * g_hz + g_e - u * g_f0 - v * g_f1;
        g_u += r0 * g_e - r2 * g_f0;
        g_v += r1 * g_e - r2 * g_f1;
        const double g_weight = e * (h_dot + e * g_a0) + r0 * (r0 * g_bxx + r1 * g_bxy)
            + r1 * r1 * g_byy;
        const double g_others = f0 * (f0 * g_fxx + f1 * g_fxy) + f1 * f1 * g_fyy;
        grad_logs[k] -= 2.0 * weight * g_weight;
        grad_logs[i] -= 2.0 * others * g_others;
        grad_logs[j] -= 2.0 * others * g_others;
    }
    grad_mean[0] = g_u / z;
    grad_mean[1] = g_v / z;
    grad_mean[2] = g_z - (g_u * u + g_v * v) / z;
}

// Gradient on a raw quaternion of length `norm` from the one on its rotation g (row by row).
__device__ __forceinline__ void quat_gradient(const float* quat, double norm, const double* g, double* out) {
    const double w = quat[0] / norm, x = quat[1] / norm, y = quat[2] / norm, z = quat[3] / norm;
    const double o0 = 2.0 * (x * (g[7] - g[5]) + y * (g[2] - g[6]) + z * (g[3] - g[1]));
    const double o1 = 2.0 * (w * (g[7] - g[5]) + y * (g[1] + g[3]) + z * (g[2] + g[6]) - 2.0 * x * (g[4] + g[8]));
    const double o2 = 2.0 * (w * (g[2] - g[6]) + x * (g[1] + g[3]) + z * (g[5] + g[7]) - 2.0 * y * (g[0] + g[8]));
    const double o3 = 2.0 * (w * (g[3] - g[1]) + x * (g[2] + g[6]) + y * (g[5] + g[7]) - 2.0 * z * (g[0] + g[4]));
    const double along = o0 * w + o1 * x + o2 * y + o3 * z;
    out[0] = (o0 - along * w) / norm;
    out[1] = (o1 - along * x) / norm;
    out[2] = (o2 - along * y) / norm;
    out[3] = (o3 - along * z) / norm;
}

// out = sum_k c[k] times the partial derivatives of harmonic k, x, y and z independent.
__device__ __forceinline__ void harmonics_pull(
    int degree, double x, double y, double z, const double* c, double* out) {
    out[0] = out[1] = out[2] = 0.0;
    if (degree < 1) return;
    out[0] = -SH_C1 * c[3];
    out[1] = -SH_C1 * c[1];
    out[2] = SH_C1 * c[2];
    if (degree < 2) return;
    out[0] += SH_C2A * (y * c[4] - z * c[7]) + 2.0 * x * (SH_C2C * c[8] - SH_C2B * c[6]);
    out[1] += SH_C2A * (x * c[4] - z * c[5]) - 2.0 * y * (SH_C2C * c[8] + SH_C2B * c[6]);
    out[2] += -SH_C2A * (y * c[5] + x * c[7]) + 4.0 * SH_C2B * z * c[6];
    if (degree < 3) return;
    const double xx = x * x, yy = y * y, zz = z * z;
    out[0] += -6.0 * SH_C3A * x * y * c[9] + SH_C3B * y * z * c[10] + 2.0 * SH_C3C * x * y * c[11]
        - 6.0 * SH_C3D * x * z * c[12] - SH_C3C * (4.0 * zz - 3.0 * xx - yy) * c[13]
        + 2.0 * SH_C3E * x * z * c[14] - 3.0 * SH_C3A * (xx - yy) * c[15];
    out[1] += -3.0 * SH_C3A * (xx - yy) * c[9] + SH_C3B * x * z * c[10]
        - SH_C3C * (4.0 * zz - xx - 3.0 * yy) * c[11] - 6.0 * SH_C3D * y * z * c[12]
        + 2.0 * SH_C3C * x * y * c[13] - 2.0 * SH_C3E * y * z * c[14] + 6.0 * SH_C3A * x * y * c[15];
    out[2] += SH_C3B * x * y * c[10] - 8.0 * SH_C3C * y * z * c[11]
        + SH_C3D * (6.0 * zz - 3.0 * xx - 3.0 * yy) * c[12] - 8.0 * SH_C3C * x * z * c[13]
        + SH_C3E * (xx - yy) * c[14];
}

// Writes the rows of visible Gaussians. All rows must be 0 before; the others, and those whose
// gradient overflows float32, stay 0.
extern "C" __global__ void __launch_bounds__(BLOCK) project_backward(
    int count, const float* means, const float* log_scales, const float* quats,
    const float* opacity_logits, const float* sh, int coefficients, int degree,
    const float* orientation, const float* filter_3d, CameraValues camera,
    const unsigned char* visible, const float4* grad_params, float* grad_means,
    float* grad_log_scales, float* grad_quats, float* grad_opacity_logits, float* grad_sh,
    float* grad_orientation) {
    const int64 i = (int64)blockIdx.x * BLOCK + threadIdx.x;
    if (i >= count || !visible[i]) return;
    float grad[24];
#pragma unroll
    for (int quad = 0; quad < ROW_QUADS; ++quad) {
        const float4 part = grad_params[i * ROW_QUADS + quad];
        grad[4 * quad] = part.x;
        grad[4 * quad + 1] = part.y;
        grad[4 * quad + 2] = part.z;
        grad[4 * quad + 3] = part.w;
    }
    // Recompute the activations of the forward pass; cheaper than storing them.
    const double m[3] = {means[3 * i], means[3 * i + 1], means[3 * i + 2]};
    double local[3], rotation[9], axes[9], variances[3], kept[3];
    to_camera(camera, m, local);
    const double norm = rotation_from_quat(quats + 4 * i, rotation);
    camera_axes(camera, rotation, axes);
    const double filter_sq = (double)filter_3d[i] * (double)filter_3d[i];
    double product = 1.0;
#pragma unroll
    for (int k = 0; k < 3; ++k) {
        const double raw = exp(2.0 * (double)log_scales[3 * i + k]);
        variances[k] = raw + filter_sq;
        kept[k] = raw / variances[k];
        product *= kept[k];
    }
    const double opacity = sqrt(product) / (1.0 + exp(-(double)opacity_logits[i]));
    const double fade = 1.0 / (1.0 + exp((double)opacity_logits[i]));

    double grad_axes[9], grad_logs[3], grad_local[3];
    shape_gradient(local, variances, camera, axes, grad, grad_axes, grad_logs, grad_local);
    const double g_log_opacity = grad[11] * opacity;
    double g_quat[4] = {0.0, 0.0, 0.0, 0.0};
    if (norm > 0.0) {
        double grad_rotation[9];
#pragma unroll
        for (int row = 0; row < 3; ++row)
#pragma unroll
            for (int k = 0; k < 3; ++k)
                grad_rotation[3 * row + k] = camera.v[row] * grad_axes[k]
                    + camera.v[3 + row] * grad_axes[3 + k] + camera.v[6 + row] * grad_axes[6 + k];
        quat_gradient(quats + 4 * i, norm, grad_rotation, g_quat);
    }

    // Colour, through the coefficients and through the viewing direction.
    double d[3] = {m[0] - camera.v[12], m[1] - camera.v[13], m[2] - camera.v[14]};
    const double distance = sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    d[0] /= distance, d[1] /= distance, d[2] /= distance;
    const int used = (degree + 1) * (degree + 1);
    double basis[16], pull[16], g[3], g_color[3];
    harmonics(degree, d[0], d[1], d[2], basis);
#pragma unroll
    for (int k = 0; k < 16; ++k) pull[k] = 0.0;
#pragma unroll
    for (int channel = 0; channel < 3; ++channel) {
        const float* stored = sh + i * coefficients * 3;
        g_color[channel] = harmonics_color(stored, used, basis, channel) < 0.0 ? 0.0 : grad[13 + channel];
#pragma unroll
        for (int k = 0; k < 16; ++k)
            if (k < used) pull[k] += g_color[channel] * (double)stored[3 * k + channel];
    }
    harmonics_pull(degree, d[0], d[1], d[2], pull, g);
    const double along = g[0] * d[0] + g[1] * d[1] + g[2] * d[2];

    // Learned normal tanh(s) d / |d|.
    double g_orientation[4] = {0.0, 0.0, 0.0, 0.0};
    double n[3] = {orientation[4 * i], orientation[4 * i + 1], orientation[4 * i + 2]};
    const double length = sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
    if (length > DIRECTION_MIN_NORM) {
        const double gain = tanh((double)orientation[4 * i + 3]);
        n[0] /= length, n[1] /= length, n[2] /= length;
        const double toward = grad[16] * n[0] + grad[17] * n[1] + grad[18] * n[2];
#pragma unroll
        for (int column = 0; column < 3; ++column)
            g_orientation[column] = gain * (grad[16 + column] - toward * n[column]) / length;
        g_orientation[3] = (1.0 - gain * gain) * toward;
    }

    // Mean and log scales last, in place; then all gradients are written, or none.
    const double g_logit = g_log_opacity * fade;
    double total = fabs(g_logit) + BASIS_MAX * (fabs(g_color[0]) + fabs(g_color[1]) + fabs(g_color[2]));
#pragma unroll
    for (int k = 0; k < 3; ++k) {
        // d(effective log scale) = kept * d(log scale); the filter also reduces the opacity.
        grad_logs[k] = kept[k] * grad_logs[k] + (1.0 - kept[k]) * g_log_opacity;
        d[k] = camera.v[k] * grad_local[0] + camera.v[3 + k] * grad_local[1]
            + camera.v[6 + k] * grad_local[2] + (g[k] - along * d[k]) / distance;
        total += fabs(grad_logs[k]) + fabs(d[k]);
    }
#pragma unroll
    for (int k = 0; k < 4; ++k) total += fabs(g_quat[k]) + fabs(g_orientation[k]);
    if (!(total < GRADIENT_MAX)) return;
    grad_opacity_logits[i] = (float)g_logit;
#pragma unroll
    for (int k = 0; k < 3; ++k) {
        grad_log_scales[3 * i + k] = (float)grad_logs[k];
        grad_means[3 * i + k] = (float)d[k];
    }
#pragma unroll
    for (int k = 0; k < 4; ++k) {
        grad_quats[4 * i + k] = (float)g_quat[k];
        grad_orientation[4 * i + k] = (float)g_orientation[k];
    }
#pragma unroll
    for (int k = 0; k < 16; ++k)
        if (k < used)
#pragma unroll
            for (int channel = 0; channel < 3; ++channel)
                grad_sh[(i * coefficients + k) * 3 + channel] = (float)(g_color[channel] * basis[k]);
}
