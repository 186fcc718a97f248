// The classical method of order 4 on the double pendulum without trigonometry: sine and cosine of both angles carried
// as state, in groups of eight lanes kept in vector registers (GCC's vector types), lanes shared out by OpenMP.
// constants: (m1+m2) l1^2, m2 l2^2, m2 l1 l2, (m1+m2) g l1, m2 g l2, and the two of the determinant.
typedef double lanes __attribute__((vector_size(64)));
enum { WIDTH = 8, GROUPS = 2 };
typedef struct {
    lanes theta1, theta2, sin1, cos1, sin2, cos2, p1, p2;
} state;

#define ALL(DO) DO(theta1) DO(theta2) DO(sin1) DO(cos1) DO(sin2) DO(cos2) DO(p1) DO(p2)

static inline __attribute__((always_inline)) void slope(const double *c, const state *x, state *k) {
    lanes sine = x->sin1 * x->cos2 - x->cos1 * x->sin2, cosine = x->cos1 * x->cos2 + x->sin1 * x->sin2;
    lanes inverse = 1.0 / (c[5] + c[6] * (sine * sine)), coupling = c[2] * cosine;
    lanes omega1 = (c[1] * x->p1 - coupling * x->p2) * inverse;
    lanes omega2 = (c[0] * x->p2 - coupling * x->p1) * inverse;
    lanes pull = c[2] * (omega1 * omega2) * sine;
    k->theta1 = omega1, k->theta2 = omega2;
    k->sin1 = x->cos1 * omega1, k->cos1 = -x->sin1 * omega1, k->sin2 = x->cos2 * omega2, k->cos2 = -x->sin2 * omega2;
    k->p1 = -pull - c[3] * x->sin1, k->p2 = pull - c[4] * x->sin2;
}

static inline __attribute__((always_inline)) void step(const double *c, state *x, double h) {
    state k, y, sum;
    slope(c, x, &k);
#define DO(m) sum.m = k.m; y.m = x->m + 0.5 * h * k.m;
    ALL(DO)
#undef DO
    slope(c, &y, &k);
#define DO(m) sum.m += 2.0 * k.m; y.m = x->m + 0.5 * h * k.m;
    ALL(DO)
#undef DO
    slope(c, &y, &k);
#define DO(m) sum.m += 2.0 * k.m; y.m = x->m + h * k.m;
    ALL(DO)
#undef DO
    slope(c, &y, &k);
#define DO(m) x->m += (h / 6.0) * (sum.m + k.m);
    ALL(DO)
#undef DO
}

// data: eight arrays of n lanes each, one after the other, in the order of `state`; n a multiple of 16.
void run(const double *c, double *data, long n, long steps, double h) {
#pragma omp parallel for schedule(static)
    for (long i = 0; i < n; i += WIDTH * GROUPS) {
        state x[GROUPS];
        for (int g = 0; g < GROUPS; g++)
            for (int m = 0; m < 8; m++) ((lanes *)&x[g])[m] = *(lanes *)(data + m * n + i + WIDTH * g);
        for (long t = 0; t < steps; t++)
            for (int g = 0; g < GROUPS; g++) step(c, &x[g], h);
        for (int g = 0; g < GROUPS; g++)
            for (int m = 0; m < 8; m++) *(lanes *)(data + m * n + i + WIDTH * g) = ((lanes *)&x[g])[m];
    }
}
