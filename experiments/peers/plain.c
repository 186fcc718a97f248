// The classical method of order 4 in (theta, p), sine and cosine by Cody and Waite's reduction and fdlibm's polynomials,
// in one group of eight lanes kept in vector registers (GCC's vector types), lanes shared out by OpenMP.
typedef double lanes __attribute__((vector_size(64)));
typedef long long whole __attribute__((vector_size(64)));
enum { WIDTH = 8 };
typedef struct {
    lanes theta1, theta2, p1, p2;
} state;

static inline __attribute__((always_inline)) void sincos8(lanes x, lanes *sine, lanes *cosine) {
    const double magic = 6755399441055744.0; // 1.5 2^52: adding it rounds to a whole number in the low bits
    lanes shifted = x * 0.63661977236758134308 + magic;
    whole n = (whole)shifted;
    lanes turns = shifted - magic;
    lanes r = ((x - turns * 1.57079632673412561417e+00) - turns * 6.07710050630396597660e-11) - turns * 2.02226624879595063154e-21;
    lanes z = r * r;
    lanes s = 1.58969099521155010221e-10 * z + -2.50507602534068634195e-08;
    s = s * z + 2.75573137070700676789e-06, s = s * z + -1.98412698298579493134e-04;
    s = s * z + 8.33333333332248946124e-03, s = s * z + -1.66666666666666324348e-01, s = r + r * z * s;
    lanes k = -1.13596475577881948265e-11 * z + 2.08757232129817482790e-09;
    k = k * z + -2.75573143513906633035e-07, k = k * z + 2.48015872894767294178e-05;
    k = k * z + -1.38888888888741095749e-03, k = k * z + 4.16666666666666019037e-02, k = 1.0 - (0.5 * z - z * z * k);
    whole odd = (n & 1) != 0;
    lanes a = (lanes)(((whole)k & odd) | ((whole)s & ~odd)), b = (lanes)(((whole)s & odd) | ((whole)k & ~odd));
    *sine = (lanes)((whole)a ^ ((n & 2) << 62)), *cosine = (lanes)((whole)b ^ (((n + 1) & 2) << 62));
}

static inline __attribute__((always_inline)) void slope(const double *c, const state *x, state *k) {
    lanes sin1, cos1, sin2, cos2;
    sincos8(x->theta1, &sin1, &cos1), sincos8(x->theta2, &sin2, &cos2);
    lanes sine = sin1 * cos2 - cos1 * sin2, cosine = cos1 * cos2 + sin1 * sin2;
    lanes inverse = 1.0 / (c[5] + c[6] * (sine * sine)), coupling = c[2] * cosine;
    k->theta1 = (c[1] * x->p1 - coupling * x->p2) * inverse;
    k->theta2 = (c[0] * x->p2 - coupling * x->p1) * inverse;
    lanes pull = c[2] * (k->theta1 * k->theta2) * sine;
    k->p1 = -pull - c[3] * sin1, k->p2 = pull - c[4] * sin2;
}

// data: four arrays of n lanes each, one after the other, in the order of `state`; n a multiple of 8.
void run(const double *c, double *data, long n, long steps, double h) {
#pragma omp parallel for schedule(static)
    for (long i = 0; i < n; i += WIDTH) {
        state x, k, y, sum;
        for (int m = 0; m < 4; m++) ((lanes *)&x)[m] = *(lanes *)(data + m * n + i);
#define ALL(DO) DO(theta1) DO(theta2) DO(p1) DO(p2)
        for (long t = 0; t < steps; t++) {
            slope(c, &x, &k);
#define DO(m) sum.m = k.m; y.m = x.m + 0.5 * h * k.m;
            ALL(DO)
#undef DO
            slope(c, &y, &k);
#define DO(m) sum.m += 2.0 * k.m; y.m = x.m + 0.5 * h * k.m;
            ALL(DO)
#undef DO
            slope(c, &y, &k);
#define DO(m) sum.m += 2.0 * k.m; y.m = x.m + h * k.m;
            ALL(DO)
#undef DO
            slope(c, &y, &k);
#define DO(m) x.m += (h / 6.0) * (sum.m + k.m);
            ALL(DO)
#undef DO
        }
        for (int m = 0; m < 4; m++) *(lanes *)(data + m * n + i) = ((lanes *)&x)[m];
    }
}
