/* The roll model on its stand, one vehicle after another in double precision: what a careful
   programmer writes by hand. Vehicles lie side by side in blocks so that the compiler vectorises
   over them. Each returns the mean square of measured - simulated over the record. */
#include <math.h>
#include <stddef.h>

#ifndef LANES
#define LANES 8 /* vehicles in flight at once: -DLANES=16 */
#endif

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

#define SLOPES(P, Q, F, G, a, b, c, d)                                                    \
  double a = (Q), b = p[4][l] * u[k] + p[5][l] * (F) - p[6][l] * (P) - p[7][l] * (Q), c = (G), \
         d = p[0][l] * (u[k] * p[1][l] - ((G) + (Q)) * p[2][l]) - p[3][l] * (F);

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
          double P = x[0][l], Q = x[1][l], F = x[2][l], G = x[3][l];
          SLOPES(P, Q, F, G, a1, b1, c1, d1)
          SLOPES(P + h / 2 * a1, Q + h / 2 * b1, F + h / 2 * c1, G + h / 2 * d1, a2, b2, c2, d2)
          SLOPES(P + h / 2 * a2, Q + h / 2 * b2, F + h / 2 * c2, G + h / 2 * d2, a3, b3, c3, d3)
          SLOPES(P + h * a3, Q + h * b3, F + h * c3, G + h * d3, a4, b4, c4, d4)
          x[0][l] = P + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4);
          x[1][l] = Q + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4);
          x[2][l] = F + h / 6 * (c1 + 2 * c2 + 2 * c3 + c4);
          x[3][l] = G + h / 6 * (d1 + 2 * d2 + 2 * d3 + d4);
        }
    }
    for (int l = 0; l < LANES; l++) cost[v + l] = c[l] / N;
  }
}
