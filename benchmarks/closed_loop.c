/* A digital PD loop around a cart with viscous and Coulomb friction, written by hand for this cart alone: what the
   compiled kernel is compared with. Third-order Taylor steps, split where the velocity reverses; at rest the cart stays
   until the push exceeds the friction. */
#include <math.h>

typedef struct {
    double gain, damping, level;
} cart;

static double reversal(double c0, double c1, double c2, double c3, double h)
{
    double low = 0.0, high = h, tau = 0.5 * h;
    int positive = c0 > 0.0 || (c0 == 0.0 && c1 > 0.0);
    for (int i = 0; i < 60; i++) {
        double f = c0 + tau * (c1 + tau * (c2 + tau * c3));
        if ((f > 0.0) == positive)
            low = tau;
        else
            high = tau;
        double slope = c1 + tau * (2.0 * c2 + tau * 3.0 * c3);
        double next = slope != 0.0 ? tau - f / slope : 0.5 * (low + high);
        if (!(low < next && next < high))
            next = 0.5 * (low + high);
        if (fabs(next - tau) <= 1e-15 * h)
            return next;
        tau = next;
    }
    return tau;
}

static void advance(const cart *p, double *y, double *v, double h, double u)
{
    for (int i = 0; i < 8; i++) {
        double push = p->gain * u - p->damping * *v;
        double d;
        if (*v == 0.0) {
            d = push < 0.0 ? -1.0 : 1.0;
            if (push * d <= p->level)
                return;
        } else
            d = *v > 0.0 ? 1.0 : -1.0;
        double a = push - d * p->level, j = -p->damping * a, s = -p->damping * j;
        double after = *v + h * (a + h * (j / 2.0 + h * s / 6.0));
        if (after * d > 0.0) {
            *y += h * (*v + h * (a / 2.0 + h * (j / 6.0 + h * s / 24.0)));
            *v = after;
            return;
        }
        double tau;
        if (*v == 0.0) {
            if (a * d <= 0.0)
                return;
            tau = reversal(a, j / 2.0, s / 6.0, 0.0, h);
        } else
            tau = reversal(*v, a, j / 2.0, s / 6.0, h);
        *y += tau * (*v + tau * (a / 2.0 + tau * (j / 6.0 + tau * s / 24.0)));
        *v = 0.0;
        h -= tau;
        if (h <= 0.0)
            return;
    }
}

void run(long n, const double *time, const double *reference, double kp, double kd, double period, double resolution,
         double gain, double damping, double level, long substeps, double *position, double *velocity, double *voltage,
         double *measured)
{
    cart p = {gain, damping, level};
    double y = 0.0, v = 0.0;
    for (long k = 0; k < n; k++) {
        double seen = resolution > 0.0 ? floor(y / resolution + 0.5) * resolution : y;
        double slope = k ? (seen - measured[k - 1]) / period : 0.0;
        double u = kp * (reference[k] - seen) - kd * slope;
        position[k] = y;
        velocity[k] = v;
        measured[k] = seen;
        voltage[k] = u;
        if (k + 1 < n) {
            double h = (time[k + 1] - time[k]) / substeps;
            for (long i = 0; i < substeps; i++)
                advance(&p, &y, &v, h, u);
        }
    }
}
