/* Lower limit of the time of a filter: `paper-aco-fckf` written by hand in C, without checks and reports.

   State x = [v_x, v_y, a_x, a_y, r, mu], four Dugoff tyres, twelve cubature points carried by Heun's rule, covariance
   summed and factorized, Carlson's triangular update, R adapted by five fuzzy sets. One vehicle is one struct.
   Equations and legend: edge_agent/estimators/paper_aco_fckf.py, gaussian/planar.py, dynamics,
   filters/columns.py, filters/sequential.py. */

#include <math.h>

enum { N = 6, POINTS = 12, ROWS = 3 };
enum { MASS, INERTIA, TO_FRONT, TO_REAR, TRACK_FRONT, TRACK_REAR, HEIGHT, RADIUS, WHEEL_INERTIA, SLOPE_X, SLOPE_Y };
enum { AX, AY, RATE, DELTA, OMEGA = DELTA + 4, INPUTS = OMEGA + 4 };

typedef struct {
    double mean[N], root[N][N], actual[ROWS], theoretical[ROWS], factor[ROWS], before[INPUTS], cosine[4], sine[4];
} Filter;

typedef struct {
    double process[N], noise[ROWS], sets_in[5], sets_out[5], least, largest, step_s, window_s, lower, upper, mu_std;
} Setting;

static double clip(double v, double low, double high) { return v < low ? low : v > high ? high : v; }

static void respond(const double *p, double vx, double vy, double r, double ax, double ay, const double *c,
                    const double *s, const double *omega, double mu, double *out) {
    double per_base = 1.0 / (p[TO_FRONT] + p[TO_REAR]), weight = p[MASS] * 9.81;
    double pitch = ax * (p[MASS] * p[HEIGHT] * per_base), least = 0.02 * weight / 4.0, fx = 0.0, fy = 0.0, moment = 0.0;
    double front = weight * p[TO_REAR] * per_base - pitch, rear = weight * p[TO_FRONT] * per_base + pitch;
    for (int w = 0; w < 4; w++) {
        double axle = w < 2 ? front : rear, track = w < 2 ? p[TRACK_FRONT] : p[TRACK_REAR];
        double left = w % 2 ? -1.0 : 1.0, x = w < 2 ? p[TO_FRONT] : -p[TO_REAR], y = left * 0.5 * track;
        double shift = left * axle * (ay * (p[HEIGHT] / (9.81 * track)));
        double load = fmax(0.5 * axle - shift, least), grip = mu * load;
        double ahead = vx - y * r, aside = vy + x * r;
        double along = c[w] * ahead + s[w] * aside, across = c[w] * aside - s[w] * ahead;
        double per_speed = 1.0 / fmax(fabs(along), 0.5);
        double free_x = p[SLOPE_X] * load * ((p[RADIUS] * omega[w] - along) * per_speed);
        double free_y = p[SLOPE_Y] * load * (-across * per_speed), free = sqrt(free_x * free_x + free_y * free_y);
        double share = grip / free, gain = 2.0 * free <= grip ? 1.0 : share * (1.0 - 0.25 * share);
        double f_ahead = gain * (c[w] * free_x - s[w] * free_y), f_left = gain * (s[w] * free_x + c[w] * free_y);
        fx += f_ahead, fy += f_left, moment += x * f_left - y * f_ahead;
    }
    double per_mass = 1.0 / p[MASS];
    out[0] = fx * per_mass, out[1] = fy * per_mass, out[2] = moment * (1.0 / p[INERTIA]);
}

static double infer(double mismatch, const double *in, const double *out) {
    if (mismatch <= in[0]) return out[0];
    for (int k = 0; k < 4; k++)
        if (mismatch < in[k + 1]) {
            double share = (mismatch - in[k]) / (in[k + 1] - in[k]);
            return (1.0 - share) * out[k] + share * out[k + 1];
        }
    return out[4];
}

/* Compute the mean and the covariance factor of the predicted points. A pivot is at least its own process noise. */
static void gather(Filter *f, double x[POINTS][N], const double *process, double pace) {
    double (*L)[N] = f->root;
    for (int i = 0; i < N; i++) {
        double total = 0.0;
        for (int k = 1; k < POINTS; k++) total += x[k][i] - x[0][i];
        f->mean[i] = x[0][i] + total * (1.0 / POINTS);
        for (int k = 0; k < POINTS; k++) x[k][i] -= f->mean[i];
    }
    for (int i = 0; i < N; i++)
        for (int j = 0; j <= i; j++) {
            double total = 0.0;
            for (int k = 0; k < POINTS; k++) total += x[k][i] * x[k][j];
            L[i][j] = total * (1.0 / POINTS);
        }
    for (int j = 0; j < N; j++) {
        double own = process[j] * process[j] * pace, total = L[j][j] + own, per;
        for (int k = 0; k < j; k++) total -= L[j][k] * L[j][k];
        L[j][j] = sqrt(fmax(total, own)), per = 1.0 / L[j][j];
        for (int i = j + 1; i < N; i++) {
            for (int k = 0; k < j; k++) L[i][j] -= L[i][k] * L[j][k];
            L[i][j] *= per, L[j][i] = 0.0;
        }
    }
}

/* Update the filter with a reading of state i with noise `after`. */
static void look(Filter *f, int i, double reading, double after) {
    double gain[N] = {0}, share;
    for (int j = i; j >= 0; j--) {
        double part = f->root[i][j], before = after, per, keep, lose;
        after = before + part * part, per = 1.0 / sqrt(before * after), keep = before * per, lose = part * per;
        for (int k = j; k < N; k++) {
            double held = f->root[k][j];
            f->root[k][j] = keep * held - lose * gain[k], gain[k] += part * held;
        }
    }
    share = (reading - f->mean[i]) / after;
    for (int k = 0; k < N; k++) f->mean[k] += gain[k] * share;
}

static void step(Filter *f, const double *p, const Setting *z, const double *now, double gone) {
    double x[POINTS][N], c[2][4], s[2][4], noise[ROWS], pace = gone / z->step_s, spread = sqrt(N);
    for (int w = 0; w < 4; w++) {
        c[0][w] = f->cosine[w], s[0][w] = f->sine[w];
        if (now[DELTA + w] != f->before[DELTA + w])
            f->cosine[w] = cos(now[DELTA + w]), f->sine[w] = sin(now[DELTA + w]);
        c[1][w] = f->cosine[w], s[1][w] = f->sine[w];
    }
    for (int k = 0; k < POINTS; k++) {
        double sign = k < N ? spread : -spread, a[3], b[3], *v = x[k];
        for (int i = 0; i < N; i++) v[i] = f->mean[i] + sign * f->root[i][k % N];
        double mu = clip(v[5], z->lower, z->upper);
        respond(p, v[0], v[1], v[4], v[2], v[3], c[0], s[0], f->before + OMEGA, mu, a);
        double kx = v[2] + v[4] * v[1], ky = v[3] - v[4] * v[0];
        double vx = v[0] + gone * kx, vy = v[1] + gone * ky, r = v[4] + gone * a[2];
        respond(p, vx, vy, r, v[2], v[3], c[1], s[1], now + OMEGA, mu, b);
        double nx = v[0] + 0.5 * gone * (kx + b[0] + r * vy), ny = v[1] + 0.5 * gone * (ky + b[1] - r * vx);
        v[4] += 0.5 * gone * (a[2] + b[2]), v[0] = nx, v[1] = ny;
        respond(p, v[0], v[1], v[4], v[2], v[3], c[1], s[1], now + OMEGA, mu, a);
        v[2] = a[0], v[3] = a[1];
    }
    gather(f, x, z->process, pace);
    double keep = exp(-log(2.0) * gone / z->window_s);
    for (int q = 0; q < ROWS; q++) {
        double variance = 0.0, miss = now[q] - f->mean[2 + q];
        for (int j = 0; j <= 2 + q; j++) variance += f->root[2 + q][j] * f->root[2 + q][j];
        noise[q] = f->factor[q] * z->noise[q];
        f->actual[q] = keep * f->actual[q] + (1.0 - keep) * miss * miss;
        f->theoretical[q] = keep * f->theoretical[q] + (1.0 - keep) * (variance + noise[q]);
        double more = pace * infer(f->actual[q] / f->theoretical[q] - 1.0, z->sets_in, z->sets_out);
        f->factor[q] = clip(f->factor[q] * exp(more), z->least, z->largest);
    }
    for (int q = 0; q < ROWS; q++) look(f, 2 + q, now[q], noise[q]);
    f->mean[5] = clip(f->mean[5], z->lower, z->upper);
    double square = 0.0;
    for (int j = 0; j < N; j++) square += f->root[5][j] * f->root[5][j];
    if (sqrt(square) > z->mu_std)
        for (int j = 0; j < N; j++) f->root[5][j] *= z->mu_std / sqrt(square);
    for (int i = 0; i < INPUTS; i++) f->before[i] = now[i];
}

/* Run the filters. Shapes: readings (samples, vehicles, INPUTS), parameters (vehicles, 12), out (samples, vehicles, N)
   with the means. */
void drive(Filter *filters, const double *parameters, const Setting *z, const double *readings, double gone, int samples,
           int vehicles, double *out) {
#pragma omp parallel for schedule(static)
    for (int n = 0; n < vehicles; n++)
        for (int k = 0; k < samples; k++) {
            step(filters + n, parameters + 12 * n, z, readings + ((long)k * vehicles + n) * INPUTS, gone);
            for (int i = 0; i < N; i++) out[((long)k * vehicles + n) * N + i] = filters[n].mean[i];
        }
}

int filter_bytes(void) { return sizeof(Filter); }
