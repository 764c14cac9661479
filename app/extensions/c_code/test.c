/* Folds the vectors and prints the largest differences from the estimates in them: of a mean, relative to its size and
   standard deviation; of a standard deviation, relative to it; of the NIS. Fails if one of the first two is above the
   bound, or a verdict differs. Arguments: the vectors, the bound. */

enum { WIDE = ROWS > INPUTS ? ROWS : INPUTS, COLUMNS = 4 + WIDE + ROWS + 2 * SHOWN };

int main(int count, char **arguments)
{
    const double bound = count > 2 ? atof(arguments[2]) : 1e-12;
    static char line[32 * COLUMNS + 32];
    FILTER filter;
    double mean_error = 0, std_error = 0, nis_error = 0;
    long rows = 0, wrong = 0;
    FILE *file = fopen(count > 1 ? arguments[1] : VECTORS, "r");
    if (!file) {
        perror(count > 1 ? arguments[1] : VECTORS);
        return 2;
    }
    START(&filter);
    while (fgets(line, sizeof line, file)) {
        double cells[COLUMNS];
        char *at = line;
        for (int k = 0; k < COLUMNS; k++) {
            cells[k] = strtod(at, &at);
            if (*at == ',') at++;
        }
        const int sensor = (int)cells[0];
        const double *value = cells + 2, *variance = value + WIDE, *verdicts = variance + ROWS;
        const double *mean = verdicts + 2, *std = mean + SHOWN;
        REAL y[WIDE], r[ROWS], nis = 0;
        int dof = 0;
        PREDICT(&filter, u, (REAL)cells[1]);
        for (int k = 0; k < WIDE; k++) y[k] = (REAL)value[k];
        for (int k = 0; k < ROWS; k++) r[k] = (REAL)variance[k];
        for (int k = 0; k < INPUTS && sensor == -1; k++)
            if (isfinite(y[k])) u[k] = y[k];
        if (sensor >= 0) {
            if (update(&filter, sensor, y, r, &nis, &dof) != (int)verdicts[0]) wrong++;
            if (isfinite(verdicts[1])) nis_error = fmax(nis_error, fabs((double)nis - verdicts[1]));
        }
        for (int k = 0; k < SHOWN; k++) {
            const double size = fabs(mean[k]) + std[k], own = STD(&filter, k);
            const double error = fabs((double)filter.x[k] - mean[k]);
            mean_error = isfinite(error) ? fmax(mean_error, size > 0 ? error / size : error) : INFINITY;
            if (own >= 0 && std[k] > 0) std_error = fmax(std_error, fabs(own - std[k]) / std[k]);
        }
        rows++;
    }
    fclose(file);
    printf("%ld rows; largest differences: mean %.3g, standard deviation %.3g, NIS %.3g; %ld verdicts differ\n", rows,
           mean_error, std_error, nis_error, wrong);
    return rows > 0 && wrong == 0 && mean_error <= bound && std_error <= bound ? 0 : 1;
}
