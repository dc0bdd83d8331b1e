/* The roll model on its stand, one vehicle after another in double precision: what a careful
   programmer writes by hand. Vehicles lie side by side in blocks so that the compiler vectorises
   over them. Each returns the mean square of measured - simulated over the record. */
#include <math.h>
#include <stddef.h>

#define LANES 8

/* coef: (20, n): Ad row by row (16), then Bd (4). */
void exact(const double *coef, const double *u, const double *y, double *cost, size_t n, size_t N) {
  for (size_t v = 0; v < n; v += LANES) {
    double a[4][4][LANES], b[4][LANES], x[4][LANES] = {{0}}, c[LANES] = {0};
    for (int i = 0; i < 4; i++)
      for (int l = 0; l < LANES; l++) {
        b[i][l] = coef[(16 + i) * n + v + l];
        for (int j = 0; j < 4; j++) a[i][j][l] = coef[(4 * i + j) * n + v + l];
      }
    for (size_t k = 0; k < N; k++) {
      double z[4][LANES];
      for (int l = 0; l < LANES; l++) {
        double e = y[k] - x[0][l];
        c[l] += e * e;
      }
      for (int i = 0; i < 4; i++)
        for (int l = 0; l < LANES; l++)
          z[i][l] = a[i][0][l] * x[0][l] + a[i][1][l] * x[1][l] + a[i][2][l] * x[2][l] +
                    a[i][3][l] * x[3][l] + b[i][l] * u[k];
      for (int i = 0; i < 4; i++)
        for (int l = 0; l < LANES; l++) x[i][l] = z[i][l];
    }
    for (int l = 0; l < LANES; l++) cost[v + l] = c[l] / N;
  }
}

/* par: (8, n): k1, 1/L5, 1/Omega, Omega^2, k2 L3, k2 L2 L4, kappa, zeta. */
void rk4(const double *par, const double *u, const double *y, double *cost, size_t n, size_t N,
         double dt, int substeps) {
  double h = dt / substeps;
  for (size_t v = 0; v < n; v += LANES) {
    double p[8][LANES], x[4][LANES] = {{0}}, c[LANES] = {0};
    for (int i = 0; i < 8; i++)
      for (int l = 0; l < LANES; l++) p[i][l] = par[i * n + v + l];
    for (size_t k = 0; k < N; k++) {
      for (int l = 0; l < LANES; l++) {
        double e = y[k] - x[0][l];
        c[l] += e * e;
      }
      for (int s = 0; s < substeps; s++)
        for (int l = 0; l < LANES; l++) {
          double w[4], f[4], g[4] = {0, 0, 0, 0};
          for (int i = 0; i < 4; i++) w[i] = x[i][l];
          for (int stage = 0; stage < 4; stage++) {
            f[0] = w[1];
            f[1] = p[4][l] * u[k] + p[5][l] * w[2] - p[6][l] * w[0] - p[7][l] * w[1];
            f[2] = w[3];
            f[3] = p[0][l] * (u[k] * p[1][l] - (w[3] + w[1]) * p[2][l]) - p[3][l] * w[2];
            double weight = (stage == 1 || stage == 2) ? 2.0 : 1.0;
            double ahead = (stage == 2) ? h : 0.5 * h;
            for (int i = 0; i < 4; i++) g[i] += weight * f[i];
            if (stage < 3)
              for (int i = 0; i < 4; i++) w[i] = x[i][l] + ahead * f[i];
          }
          for (int i = 0; i < 4; i++) x[i][l] += h / 6.0 * g[i];
        }
    }
    for (int l = 0; l < LANES; l++) cost[v + l] = c[l] / N;
  }
}
