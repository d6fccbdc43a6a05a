/* Lower limit of the time of a bank: `paper-aco-fckf` as in kernel.c, with LANES vehicles in vectors (structure of arrays).

   Every quantity is a vector over vehicles, so that each operation is one instruction for all of them. Selections replace
   the branches of kernel.c. No operation is reassociated: results differ from kernel.c only by the vector exp, sin, cos. */

#include <math.h>

enum { LANES = 8, N = 6, POINTS = 12, ROWS = 3 };
enum { MASS, INERTIA, TO_FRONT, TO_REAR, TRACK_FRONT, TRACK_REAR, HEIGHT, RADIUS, WHEEL_INERTIA, SLOPE_X, SLOPE_Y, PARAMETERS = 12 };
enum { AX, AY, RATE, DELTA, OMEGA = DELTA + 4, INPUTS = OMEGA + 4 };

typedef double V __attribute__((vector_size(8 * LANES)));
typedef long M __attribute__((vector_size(8 * LANES)));

/* vector functions of glibc; otherwise gcc uses them only with fast-math */
__attribute__((simd("notinbranch"))) double exp(double);
__attribute__((simd("notinbranch"))) double sin(double);
__attribute__((simd("notinbranch"))) double cos(double);

typedef struct {
    V mean[N], root[N][N], actual[ROWS], theoretical[ROWS], factor[ROWS], before[INPUTS], cosine[4], sine[4];
} Filters;

typedef struct {
    double process[N], noise[ROWS], sets_in[5], sets_out[5], least, largest, step_s, window_s, lower, upper, mu_std;
} Setting;

#define INLINE static inline __attribute__((always_inline))
#define EACH(function)                                                                                                 \
    INLINE V each_##function(V a) {                                                                                    \
        double in[LANES] __attribute__((aligned(64))), out[LANES] __attribute__((aligned(64)));                        \
        *(V *)in = a;                                                                                                  \
        _Pragma("omp simd aligned(in, out : 64)") for (int l = 0; l < LANES; l++) out[l] = function(in[l]);            \
        return *(V *)out;                                                                                              \
    }
EACH(sqrt)
EACH(exp)
EACH(sin)
EACH(cos)

INLINE V choose(M where, V a, V b) { return (V)((where & (M)a) | (~where & (M)b)); }
INLINE V most(V a, V b) { return choose(a > b, a, b); }
INLINE V clip(V v, double low, double high) {
    V l = v * 0.0 + low, h = v * 0.0 + high;
    return choose(v < l, l, choose(v > h, h, v));
}
INLINE V size(V a) { return (V)((M)a & 0x7fffffffffffffffL); }
INLINE int any(M m) {
    long found = 0;
    for (int l = 0; l < LANES; l++) found |= m[l];
    return found != 0;
}

INLINE void respond(const V *p, V vx, V vy, V r, V ax, V ay, const V *c, const V *s, const V *omega, V mu, V *out) {
    V per_base = 1.0 / (p[TO_FRONT] + p[TO_REAR]), weight = p[MASS] * 9.81;
    V pitch = ax * (p[MASS] * p[HEIGHT] * per_base), least = 0.02 * weight / 4.0, fx = {0}, fy = {0}, moment = {0};
    V front = weight * p[TO_REAR] * per_base - pitch, rear = weight * p[TO_FRONT] * per_base + pitch;
    for (int w = 0; w < 4; w++) {
        V axle = w < 2 ? front : rear, track = w < 2 ? p[TRACK_FRONT] : p[TRACK_REAR];
        double left = w % 2 ? -1.0 : 1.0;
        V x = w < 2 ? p[TO_FRONT] : -p[TO_REAR], y = left * 0.5 * track;
        V shift = left * axle * (ay * (p[HEIGHT] / (9.81 * track)));
        V load = most(0.5 * axle - shift, least), grip = mu * load;
        V ahead = vx - y * r, aside = vy + x * r;
        V along = c[w] * ahead + s[w] * aside, across = c[w] * aside - s[w] * ahead;
        V per_speed = 1.0 / most(size(along), along * 0.0 + 0.5);
        V free_x = p[SLOPE_X] * load * ((p[RADIUS] * omega[w] - along) * per_speed);
        V free_y = p[SLOPE_Y] * load * (-across * per_speed), free = each_sqrt(free_x * free_x + free_y * free_y);
        V share = grip / free, gain = choose(2.0 * free <= grip, share * 0.0 + 1.0, share * (1.0 - 0.25 * share));
        gain = choose(free > 0.0, gain, free * 0.0 + 1.0);
        V f_ahead = gain * (c[w] * free_x - s[w] * free_y), f_left = gain * (s[w] * free_x + c[w] * free_y);
        fx += f_ahead, fy += f_left, moment += x * f_left - y * f_ahead;
    }
    out[0] = fx / p[MASS], out[1] = fy / p[MASS], out[2] = moment / p[INERTIA];
}

INLINE V infer(V mismatch, const double *in, const double *out) {
    V found = mismatch * 0.0 + out[4];
    for (int k = 3; k >= 0; k--) {
        V share = (mismatch - in[k]) * (1.0 / (in[k + 1] - in[k]));
        found = choose(mismatch < in[k + 1], (1.0 - share) * out[k] + share * out[k + 1], found);
    }
    return choose(mismatch <= in[0], mismatch * 0.0 + out[0], found);
}

/* Compute the mean and the covariance factor of the predicted points. A pivot is at least its own process noise. */
INLINE void gather(Filters *f, V x[POINTS][N], const double *process, double pace) {
    V(*L)[N] = f->root;
    for (int i = 0; i < N; i++) {
        V total = {0};
        for (int k = 1; k < POINTS; k++) total += x[k][i] - x[0][i];
        f->mean[i] = x[0][i] + total * (1.0 / POINTS);
        for (int k = 0; k < POINTS; k++) x[k][i] -= f->mean[i];
    }
    for (int i = 0; i < N; i++)
        for (int j = 0; j <= i; j++) {
            V total = {0};
            for (int k = 0; k < POINTS; k++) total += x[k][i] * x[k][j];
            L[i][j] = total * (1.0 / POINTS);
        }
    for (int j = 0; j < N; j++) {
        double own = process[j] * process[j] * pace;
        V total = L[j][j] + own;
        for (int k = 0; k < j; k++) total -= L[j][k] * L[j][k];
        L[j][j] = each_sqrt(most(total, total * 0.0 + own));
        V per = 1.0 / L[j][j];
        for (int i = j + 1; i < N; i++) {
            for (int k = 0; k < j; k++) L[i][j] -= L[i][k] * L[j][k];
            L[i][j] *= per, L[j][i] = (V){0};
        }
    }
}

/* Update the filters with a reading of state i with noise `after` (Carlson). */
INLINE void take(Filters *f, int i, V reading, V after) {
    V gain[N] = {{0}};
    for (int j = i; j >= 0; j--) {
        V part = f->root[i][j], before = after;
        after = before + part * part;
        V per = 1.0 / each_sqrt(before * after), keep = before * per, lose = part * per;
        for (int k = j; k < N; k++) {
            V held = f->root[k][j];
            f->root[k][j] = keep * held - lose * gain[k], gain[k] += part * held;
        }
    }
    V share = (reading - f->mean[i]) / after;
    for (int k = 0; k < N; k++) f->mean[k] += gain[k] * share;
}

INLINE void step(Filters *f, const V *p, const Setting *z, const V *now, double gone, double keep) {
    V x[POINTS][N], c[2][4], s[2][4], noise[ROWS];
    double pace = gone / z->step_s, spread = sqrt(N);
    for (int w = 0; w < 4; w++) {
        c[0][w] = f->cosine[w], s[0][w] = f->sine[w];
        if (any(now[DELTA + w] != f->before[DELTA + w]))
            f->cosine[w] = each_cos(now[DELTA + w]), f->sine[w] = each_sin(now[DELTA + w]);
        c[1][w] = f->cosine[w], s[1][w] = f->sine[w];
    }
    for (int k = 0; k < POINTS; k++) {
        double sign = k < N ? spread : -spread;
        V a[3], b[3], *v = x[k];
        for (int i = 0; i < N; i++) v[i] = f->mean[i] + sign * f->root[i][k % N];
        V mu = clip(v[5], z->lower, z->upper);
        respond(p, v[0], v[1], v[4], v[2], v[3], c[0], s[0], f->before + OMEGA, mu, a);
        V kx = v[2] + v[4] * v[1], ky = v[3] - v[4] * v[0];
        V vx = v[0] + gone * kx, vy = v[1] + gone * ky, r = v[4] + gone * a[2];
        respond(p, vx, vy, r, v[2], v[3], c[1], s[1], now + OMEGA, mu, b);
        V nx = v[0] + 0.5 * gone * (kx + b[0] + r * vy), ny = v[1] + 0.5 * gone * (ky + b[1] - r * vx);
        v[4] += 0.5 * gone * (a[2] + b[2]), v[0] = nx, v[1] = ny;
        respond(p, v[0], v[1], v[4], v[2], v[3], c[1], s[1], now + OMEGA, mu, a);
        v[2] = a[0], v[3] = a[1];
    }
    gather(f, x, z->process, pace);
    for (int q = 0; q < ROWS; q++) {
        V variance = {0}, miss = now[q] - f->mean[2 + q];
        for (int j = 0; j <= 2 + q; j++) variance += f->root[2 + q][j] * f->root[2 + q][j];
        noise[q] = f->factor[q] * z->noise[q];
        f->actual[q] = keep * f->actual[q] + (1.0 - keep) * miss * miss;
        f->theoretical[q] = keep * f->theoretical[q] + (1.0 - keep) * (variance + noise[q]);
        V more = pace * infer(f->actual[q] / f->theoretical[q] - 1.0, z->sets_in, z->sets_out);
        f->factor[q] = clip(f->factor[q] * each_exp(more), z->least, z->largest);
    }
    for (int q = 0; q < ROWS; q++) take(f, 2 + q, now[q], noise[q]);
    f->mean[5] = clip(f->mean[5], z->lower, z->upper);
    V square = {0};
    for (int j = 0; j < N; j++) square += f->root[5][j] * f->root[5][j];
    V std = each_sqrt(square), shrink = choose(std > z->mu_std, z->mu_std / std, std * 0.0 + 1.0);
    for (int j = 0; j < N; j++) f->root[5][j] *= shrink;
    for (int i = 0; i < INPUTS; i++) f->before[i] = now[i];
}

/* Run the filters. The last axis of all arrays is LANES. Other axes: filters (blocks), parameters (blocks, 12), readings
   (samples, blocks, INPUTS), out (samples, blocks, N) with the means. */
void drive(Filters *filters, const V *parameters, const Setting *z, const V *readings, double gone, int samples, int blocks,
           V *out) {
    double keep = exp(-log(2.0) * gone / z->window_s);
    for (int n = 0; n < blocks; n++)
        for (int k = 0; k < samples; k++) {
            step(filters + n, parameters + PARAMETERS * n, z, readings + ((long)k * blocks + n) * INPUTS, gone, keep);
            for (int i = 0; i < N; i++) out[((long)k * blocks + n) * N + i] = filters[n].mean[i];
        }
}

int lanes(void) { return LANES; }
int filter_bytes(void) { return sizeof(Filters); }
