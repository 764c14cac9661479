#include <math.h>
#include <stdlib.h>
#include <string.h>
typedef struct { double v[7], time; int set, dead; } M;
typedef double R;
typedef unsigned int V;
static void begin(M *m) { memset(m, 0, sizeof *m); m->v[0] = 2.0; m->v[4] = 1.0; }
static void evaluate(M *m) {
    double *v = m->v;
#if defined(DAHLQUIST)
    v[2] = -v[4] * v[0] + v[5];
#elif defined(BOUNCE)
    v[2] = v[1]; v[3] = -9.81;
#else
    v[2] = v[1]; v[3] = v[4] * (1.0 - v[0] * v[0]) * v[1] - v[0] + v[5];
#endif
#if defined(TIME)
    v[2] += 0.1 * m->time;
#elif defined(MEMORY)
    v[2] += 1e-9 * m->set;
#elif defined(OVERFLOW)
    v[2] = INFINITY;
#endif
    v[6] = v[0] + 0.5 * v[5];
}
int PRE(Reset)(M *m) { begin(m); return 0; }
int PRE(SetTime)(M *m, R t) { m->time = t; return 0; }
int PRE(SetContinuousStates)(M *m, const R *x, size_t n) {
#ifndef IGNORED
    memcpy(m->v, x, n * sizeof(R)); m->set++;
#endif
    return 0;
}
int PRE(GetContinuousStates)(M *m, R *x, size_t n) { memcpy(x, m->v, n * sizeof(R)); return 0; }
int GET_RATES(M *m, R *dx, size_t n) {
#ifdef BEYOND
    if (m->dead || m->v[0] > 5.0) { m->dead = 1; return 3; }
#endif
    evaluate(m); memcpy(dx, m->v + 2, n * sizeof(R)); return 0;
}
int GET_REAL(M *m, const V *r, size_t n, R *y REST) { evaluate(m); while (n--) y[n] = m->v[r[n]]; return 0; }
int SET_REAL(M *m, const V *r, size_t n, const R *y REST) { while (n--) m->v[r[n]] = y[n]; return 0; }
int PRE(CompletedIntegratorStep)(M *m, B no, B *enter, B *end) { *enter = *end = 0; return 0; }
int PRE(EnterEventMode)(M *m) {
#ifdef BOUNCE
    if (m->v[0] <= 0.0 && m->v[1] < 0.0) { m->v[0] = 0.0; m->v[1] *= -0.5; }
#endif
    return 0;
}
#ifdef FMI3
int fmi3UpdateDiscreteStates(M *m, B *a, B *b, B *c, B *d, B *e, R *f) { *a = *b = *c = *d = *e = 0; return 0; }
M *fmi3InstantiateModelExchange() { M *m = malloc(sizeof(M)); begin(m); return m; }
#else
int fmi2NewDiscreteStates(M *m, B *info) { memset(info, 0, 5 * sizeof(B)); return 0; }
M *fmi2Instantiate() { M *m = malloc(sizeof(M)); begin(m); return m; }
#endif
