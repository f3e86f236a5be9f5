// SPDX-License-Identifier: GPL-3.0-or-later
// Projection of raw Gaussians, one thread each, in float64: the formulas of
// projection_kernels.py, where they are derived. Roughly 1500 operations, which even at a consumer
// GPU's float64 rate should be cheap compared to the raster loops (not measured).

// Rotation of a quaternion, row by row; returns its norm, or 0 where it is degenerate.
__device__ __forceinline__ double rotation_from_quat(const float* quat, double* r) {
    double w = quat[0], x = quat[1], y = quat[2], z = quat[3];
    double norm = sqrt(w * w + x * x + y * y + z * z);
    if (norm <= QUATERNION_MIN_NORM) {
        w = 1.0;
        x = y = z = norm = 0.0;
    } else {
        w /= norm, x /= norm, y /= norm, z /= norm;
    }
    r[0] = 1.0 - 2.0 * (y * y + z * z);
    r[1] = 2.0 * (x * y - w * z);
    r[2] = 2.0 * (x * z + w * y);
    r[3] = 2.0 * (x * y + w * z);
    r[4] = 1.0 - 2.0 * (x * x + z * z);
    r[5] = 2.0 * (y * z - w * x);
    r[6] = 2.0 * (x * z - w * y);
    r[7] = 2.0 * (y * z + w * x);
    r[8] = 1.0 - 2.0 * (x * x + y * y);
    return norm;
}

// axes = camera rotation times Gaussian rotation; columns are the Gaussian's axes.
__device__ __forceinline__ void camera_axes(const CameraValues& camera, const double* r, double* axes) {
#pragma unroll
    for (int row = 0; row < 3; ++row)
#pragma unroll
        for (int k = 0; k < 3; ++k)
            axes[3 * row + k] = camera.v[3 * row] * r[k] + camera.v[3 * row + 1] * r[3 + k]
                + camera.v[3 * row + 2] * r[6 + k];
}

__device__ __forceinline__ void to_camera(const CameraValues& camera, const double* m, double* local) {
#pragma unroll
    for (int row = 0; row < 3; ++row)
        local[row] = camera.v[3 * row] * m[0] + camera.v[3 * row + 1] * m[1]
            + camera.v[3 * row + 2] * m[2] + camera.v[9 + row];
}

// Sums over the axes that all outputs depend on; names as in projection.py.
struct ShapeSums {
    double a0, hx, hy, hz, bxx, bxy, byy, fxx, fxy, fyy;
    double cov_xx, cov_xy, cov_yy, cov_xz, cov_yz, cov_zz;
};

__device__ __forceinline__ ShapeSums shape_sums(const double* axes, const double* variances, double u, double v) {
    ShapeSums s = {0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0};
#pragma unroll
    for (int k = 0; k < 3; ++k) {
        const double r0 = axes[k], r1 = axes[3 + k], r2 = axes[6 + k];
        const double variance = variances[k];
        const double inverse = 1.0 / variance;
        const double others = 1.0 / (variances[(k + 1) % 3] * variances[(k + 2) % 3]);
        const double e = r0 * u + r1 * v + r2;
        const double f0 = r0 - u * r2, f1 = r1 - v * r2;
        s.a0 += e * e * inverse;
        s.hx += r0 * e * inverse;
        s.hy += r1 * e * inverse;
        s.hz += r2 * e * inverse;
        s.bxx += r0 * r0 * inverse;
        s.bxy += r0 * r1 * inverse;
        s.byy += r1 * r1 * inverse;
        s.fxx += f0 * f0 * others;
        s.fxy += f0 * f1 * others;
        s.fyy += f1 * f1 * others;
        s.cov_xx += f0 * f0 * variance;
        s.cov_xy += f0 * f1 * variance;
        s.cov_yy += f1 * f1 * variance;
        s.cov_xz += f0 * r2 * variance;
        s.cov_yz += f1 * r2 * variance;
        s.cov_zz += r2 * r2 * variance;
    }
    return s;
}

// Real spherical harmonics, order and signs of projection_kernels.py.
__device__ __forceinline__ void harmonics(int degree, double x, double y, double z, double* out) {
    out[0] = SH_C0;
    if (degree < 1) return;
    out[1] = -SH_C1 * y;
    out[2] = SH_C1 * z;
    out[3] = -SH_C1 * x;
    if (degree < 2) return;
    const double xx = x * x, yy = y * y, zz = z * z;
    out[4] = SH_C2A * x * y;
    out[5] = -SH_C2A * y * z;
    out[6] = SH_C2B * (2.0 * zz - xx - yy);
    out[7] = -SH_C2A * x * z;
    out[8] = SH_C2C * (xx - yy);
    if (degree < 3) return;
    out[9] = -SH_C3A * y * (3.0 * xx - yy);
    out[10] = SH_C3B * x * y * z;
    out[11] = -SH_C3C * y * (4.0 * zz - xx - yy);
    out[12] = SH_C3D * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
    out[13] = -SH_C3C * x * (4.0 * zz - xx - yy);
    out[14] = SH_C3E * z * (xx - yy);
    out[15] = -SH_C3A * x * (xx - 3.0 * yy);
}

// Colour before the clamp at 0.
__device__ __forceinline__ double harmonics_color(const float* sh, int count, const double* basis, int channel) {
    double value = 0.5;
#pragma unroll
    for (int k = 0; k < 16; ++k)
        if (k < count) value += basis[k] * (double)sh[3 * k + channel];
    return value;
}

// One float32 step outwards, so that a box never loses a pixel to rounding.
__device__ __forceinline__ float outward(double value, double side) {
    value = fmin(fmax(value, -FARTHEST_PX), FARTHEST_PX);
    return (float)(value + side * FLOAT32_STEP * fabs(value));
}

// Write columns 0-12, 19-22, box, depth and skew; return whether a pixel centre is in the box.
__device__ __forceinline__ bool project_shape(
    const double* local, const double* axes, const double* variances, double opacity,
    const CameraValues& camera, float* row, float* box, float* depth, float* skew) {
    const double fx = camera.v[15], fy = camera.v[16], cx = camera.v[17], cy = camera.v[18];
    const double width = camera.v[19], height = camera.v[20];
    const double x = local[0], y = local[1], z = local[2];
    if (!(z > camera.v[21] && z > 0.0 && opacity > ALPHA_MIN_WIDE)) return false;
    const double u = x / z, v = y / z, zz = z * z;
    const ShapeSums s = shape_sums(axes, variances, u, v);
    const double inverse_a0 = 1.0 / s.a0;
    const double at_x = fx * u + cx, at_y = fy * v + cy;
    const double qa = zz * s.fyy * inverse_a0 / (fx * fx), qb = -2.0 * zz * s.fxy * inverse_a0 / (fx * fy);
    const double qc = zz * s.fxx * inverse_a0 / (fy * fy);
    const double px = s.hx * inverse_a0 / fx, py = s.hy * inverse_a0 / fy;
    const double dr = s.bxx * inverse_a0 / (fx * fx), ds = 2.0 * s.bxy * inverse_a0 / (fx * fy);
    const double dt = s.byy * inverse_a0 / (fy * fy);
    const double sigma_z = sqrt(s.cov_zz);
    // Hidden if rendering the row would overflow float32 (docs/architecture.md).
    const double reach_x = fmax(fabs(at_x), fabs(width - at_x)) + TILE;
    const double reach_y = fmax(fabs(at_y), fabs(height - at_y)) + TILE;
    const double num = qa * reach_x * reach_x + fabs(qb) * reach_x * reach_y + qc * reach_y * reach_y;
    const double most_den = 1.0 + 2.0 * (fabs(px) * reach_x + fabs(py) * reach_y)
        + dr * reach_x * reach_x + fabs(ds) * reach_x * reach_y + dt * reach_y * reach_y;
    if (!(reach_x <= FINITE_OFFSET_PX && reach_y <= FINITE_OFFSET_PX && num <= FINITE_NUM
          && most_den <= FINITE_DEN && s.a0 * s.cov_zz <= FINITE_SPREAD
          && s.a0 * most_den * z <= FINITE_PULL && z >= FINITE_Z_MIN && z <= FINITE_Z_MAX
          && sigma_z <= FINITE_SIGMA_Z))
        return false;
    row[0] = (float)at_x;
    row[1] = (float)at_y;
    row[2] = (float)qa;
    row[3] = (float)qb;
    row[4] = (float)qc;
    row[5] = (float)px;
    row[6] = (float)py;
    row[7] = (float)dr;
    row[8] = (float)ds;
    row[9] = (float)dt;
    row[10] = (float)z;
    row[11] = (float)opacity;
    row[12] = (float)s.a0;
    const double length = -1.0 / sqrt(s.hx * s.hx + s.hy * s.hy + s.hz * s.hz);
    const double hx = s.hx * length, hy = s.hy * length, hz = s.hz * length;
#pragma unroll
    for (int column = 0; column < 3; ++column)
        row[19 + column] = (float)(camera.v[column] * hx + camera.v[3 + column] * hy
            + camera.v[6 + column] * hz);
    row[22] = (float)sigma_z;
    row[23] = 0.0f;
    *depth = (float)sqrt(x * x + y * y + zz);

    const double threshold = 2.0 * log(opacity / ALPHA_MIN_WIDE);
    const double scale = zz - threshold * s.cov_zz;
    if (scale > PLANE_MARGIN * zz) {
        const double share = threshold / scale;
        const double center_x = fx * (u - share * s.cov_xz) + cx;
        const double center_y = fy * (v - share * s.cov_yz) + cy;
        const double spread_xx = share * (s.cov_xx + share * s.cov_xz * s.cov_xz);
        const double spread_xy = share * (s.cov_xy + share * s.cov_xz * s.cov_yz);
        const double spread_yy = share * (s.cov_yy + share * s.cov_yz * s.cov_yz);
        const double half_x = fx * sqrt(spread_xx), half_y = fy * sqrt(spread_yy);
        box[0] = outward(center_x - half_x, -1.0);
        box[1] = outward(center_y - half_y, -1.0);
        box[2] = outward(center_x + half_x, 1.0);
        box[3] = outward(center_y + half_y, 1.0);
        *skew = (float)(fx * spread_xy / sqrt(spread_yy));
    } else {
        box[0] = box[1] = 0.0f;
        box[2] = (float)width;
        box[3] = (float)height;
        *skew = INFINITE;
    }
    return fmax(ceil(box[0] - 0.5), 0.0) <= fmin(floor(box[2] - 0.5), width - 1.0)
        && fmax(ceil(box[1] - 0.5), 0.0) <= fmin(floor(box[3] - 0.5), height - 1.0);
}

extern "C" __global__ void __launch_bounds__(BLOCK) project_gaussians(
    int count, const float* means, const float* log_scales, const float* quats,
    const float* opacity_logits, const float* sh, int coefficients, int degree,
    const float* orientation, const float* filter_3d, CameraValues camera,
    float4* params, float4* boxes, unsigned char* visible, float* depths, float* skews) {
    const int i = blockIdx.x * BLOCK + threadIdx.x;
    if (i >= count) return;
    float row[24];
    float box[4] = {0.0f, 0.0f, -1.0f, -1.0f};
    float depth = INFINITE, skew = 0.0f;
    const double m[3] = {means[3 * (int64)i], means[3 * (int64)i + 1], means[3 * (int64)i + 2]};
    double local[3], rotation[9], axes[9], variances[3];
    to_camera(camera, m, local);
    bool seen = local[2] > camera.v[21];
    if (seen) {
        rotation_from_quat(quats + 4 * (int64)i, rotation);
        camera_axes(camera, rotation, axes);
        const double filter_sq = (double)filter_3d[i] * (double)filter_3d[i];
        double kept = 1.0;
#pragma unroll
        for (int k = 0; k < 3; ++k) {
            const double raw = exp(2.0 * (double)log_scales[3 * (int64)i + k]);
            variances[k] = raw + filter_sq;
            kept *= raw / variances[k];
        }
        const double opacity = sqrt(kept) / (1.0 + exp(-(double)opacity_logits[i]));
        seen = project_shape(local, axes, variances, opacity, camera, row, box, &depth, &skew);
    }
    if (seen) {
        const double d0 = m[0] - camera.v[12], d1 = m[1] - camera.v[13], d2 = m[2] - camera.v[14];
        const double distance = sqrt(d0 * d0 + d1 * d1 + d2 * d2);
        double basis[16];
        harmonics(degree, d0 / distance, d1 / distance, d2 / distance, basis);
#pragma unroll
        for (int channel = 0; channel < 3; ++channel) {
            const double value = harmonics_color(
                sh + (int64)i * coefficients * 3, (degree + 1) * (degree + 1), basis, channel);
            seen = seen && value <= FINITE_COLOR; // false for NaN
            row[13 + channel] = (float)fmax(value, 0.0);
        }
        const double n0 = orientation[4 * (int64)i], n1 = orientation[4 * (int64)i + 1];
        const double n2 = orientation[4 * (int64)i + 2];
        const double length = sqrt(n0 * n0 + n1 * n1 + n2 * n2);
        const double gain = tanh((double)orientation[4 * (int64)i + 3]) / fmax(length, DIRECTION_MIN_NORM);
        row[16] = (float)(gain * n0);
        row[17] = (float)(gain * n1);
        row[18] = (float)(gain * n2);
#pragma unroll
        for (int column = 0; column < 24; ++column) seen = seen && fabsf(row[column]) < FLOAT32_LARGE;
#pragma unroll
        for (int column = 0; column < 4; ++column) seen = seen && fabsf(box[column]) < FLOAT32_LARGE;
        seen = seen && depth < FLOAT32_LARGE && (skew == INFINITE || fabsf(skew) < FLOAT32_LARGE);
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
        params[(int64)i * ROW_QUADS + quad]
            = make_float4(row[4 * quad], row[4 * quad + 1], row[4 * quad + 2], row[4 * quad + 3]);
    boxes[i] = make_float4(box[0], box[1], box[2], box[3]);
    visible[i] = seen;
    depths[i] = depth;
    skews[i] = skew;
}
