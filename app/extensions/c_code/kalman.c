/* An angle brought to [-pi, pi). */
static real wrap(real angle)
{
    const real pi = R(3.14159265358979323846), whole = R(6.28318530717958647692);
    const real shifted = angle + pi;
    return shifted - floor(shifted / whole) * whole - pi;
}

/* P = F P F' + Q */
static void spread(real P[N][N], real F[N][N], real Q[N][N])
{
    real A[N][N];
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++) {
            real sum = 0;
            for (int k = 0; k < N; k++) sum += F[i][k] * P[k][j];
            A[i][j] = sum;
        }
    for (int i = 0; i < N; i++)
        for (int j = 0; j <= i; j++) {
            real sum = 0;
            for (int k = 0; k < N; k++) sum += A[i][k] * F[j][k];
            P[i][j] = sum + Q[i][j];
            P[j][i] = P[i][j];
        }
}

/* x = x + K nu, P = (I - K H) P (I - K H)' + K R K' over the rows that are not NAN (Joseph form). Rows of the gain from
   `estimated` on are zero: considered states (Schmidt's filter). */
static int correct(real *x, real P[N][N], int estimated, int rows, const real *h, real H[][N], const real *noise,
                   const real *r, const int *circular, const real *limit, const real *y, real *nis, int *dof)
{
    real nu[M], S[M][M], U[M][M], C[N][M], K[N][M], A[N][N], V[M][M], z[M];
    int at[M], m = 0;
    *nis = NAN;
    for (int k = 0; k < rows; k++)
        if (isfinite(y[k])) at[m++] = k;
    *dof = m;
    if (m == 0) return 2;
    for (int k = 0; k < m; k++) {
        nu[k] = y[at[k]] - h[at[k]];
        if (circular[at[k]]) nu[k] = wrap(nu[k]);
        for (int l = 0; l < m; l++) {
            V[k][l] = noise[at[k] * rows + at[l]];
            if (r && r[at[k]] > 0 && V[k][l] != 0) V[k][l] *= sqrt(r[at[k]] / noise[at[k] * rows + at[k]]);
            if (r && r[at[l]] > 0 && V[k][l] != 0) V[k][l] *= sqrt(r[at[l]] / noise[at[l] * rows + at[l]]);
        }
        if (r && r[at[k]] > 0) V[k][k] = r[at[k]];
    }
    for (int i = 0; i < N; i++)
        for (int k = 0; k < m; k++) {
            real sum = 0;
            for (int j = 0; j < N; j++) sum += P[i][j] * H[at[k]][j];
            C[i][k] = sum;
        }
    for (int k = 0; k < m; k++)
        for (int l = 0; l < m; l++) {
            real sum = V[k][l];
            for (int j = 0; j < N; j++) sum += H[at[k]][j] * C[j][l];
            S[k][l] = sum;
        }
    for (int k = 0; k < m; k++)
        for (int l = k; l < m; l++) {
            real sum = S[k][l];
            for (int j = 0; j < k; j++) sum -= U[j][k] * U[j][l];
            if (l == k && !(sum > 0)) return 3;
            U[k][l] = l == k ? sqrt(sum) : sum / U[k][k];
        }
    real square = 0;
    for (int k = 0; k < m; k++) {
        real sum = nu[k];
        for (int j = 0; j < k; j++) sum -= U[j][k] * z[j];
        z[k] = sum / U[k][k];
        square += z[k] * z[k];
    }
    *nis = square;
    if (!(square <= limit[m])) return square > limit[m] ? 1 : 3;
    for (int i = 0; i < N; i++) {
        for (int k = 0; k < m; k++) {
            real sum = i < estimated ? C[i][k] : R(0);
            for (int j = 0; j < k; j++) sum -= U[j][k] * K[i][j];
            K[i][k] = sum / U[k][k];
        }
        for (int k = m - 1; k >= 0; k--) {
            real sum = K[i][k];
            for (int j = k + 1; j < m; j++) sum -= U[k][j] * K[i][j];
            K[i][k] = sum / U[k][k];
        }
        for (int k = 0; k < m; k++) x[i] += K[i][k] * nu[k];
    }
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++) {
            A[i][j] = P[i][j];
            for (int k = 0; k < m; k++) A[i][j] -= K[i][k] * C[j][k];
        }
    for (int i = 0; i < N; i++)
        for (int k = 0; k < m; k++) {
            real sum = 0;
            for (int j = 0; j < N; j++) sum += A[i][j] * H[at[k]][j];
            for (int l = 0; l < m; l++) sum -= K[i][l] * V[l][k];
            C[i][k] = sum;
        }
    for (int i = 0; i < N; i++)
        for (int j = 0; j <= i; j++) {
            real sum = A[i][j];
            for (int k = 0; k < m; k++) sum -= C[i][k] * K[j][k];
            P[i][j] = sum;
            P[j][i] = sum;
        }
    return 0;
}
