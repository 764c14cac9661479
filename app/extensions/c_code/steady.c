/* An angle brought to [-pi, pi). */
static real wrap(real angle)
{
    const real pi = R(3.14159265358979323846), whole = R(6.28318530717958647692);
    const real shifted = angle + pi;
    return shifted - floor(shifted / whole) * whole - pi;
}

/* x = x + K nu with the steady gain; a measurement with a missing row is not used. */
static int correct(real *x, int rows, const real *h, const real *K, const real *S, const int *circular,
                   const real *limit, const real *y, real *nis, int *dof)
{
    real nu[M], U[M][M], z[M];
    *nis = NAN;
    *dof = 0;
    for (int k = 0; k < rows; k++) {
        if (!isfinite(y[k])) return 2;
        nu[k] = y[k] - h[k];
        if (circular[k]) nu[k] = wrap(nu[k]);
    }
    *dof = rows;
    real square = 0;
    for (int k = 0; k < rows; k++) {
        real sum = nu[k];
        for (int l = k; l < rows; l++) {
            real part = S[k * rows + l];
            for (int j = 0; j < k; j++) part -= U[j][k] * U[j][l];
            U[k][l] = l == k ? sqrt(part) : part / U[k][k];
        }
        for (int j = 0; j < k; j++) sum -= U[j][k] * z[j];
        z[k] = sum / U[k][k];
        square += z[k] * z[k];
    }
    *nis = square;
    if (!(square <= limit[rows])) return square > limit[rows] ? 1 : 3;
    for (int i = 0; i < N; i++)
        for (int k = 0; k < rows; k++) x[i] += K[i * rows + k] * nu[k];
    return 0;
}
