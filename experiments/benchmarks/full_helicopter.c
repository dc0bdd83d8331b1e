/* The full helicopter, with flapping, tail force and power and governor, in double precision: what a
   careful programmer writes by hand. Vehicles lie side by side in blocks so that the compiler
   vectorises over them; they differ in Ixx, all else is computed once before the run. */
#include <math.h>
#include <stddef.h>

#ifndef LANES
#define LANES 16 /* vehicles in flight at once: -DLANES=8 */
#endif
#define STATES 18
#define NEWTON 7
#define REST 1e-8

enum { X, Y, Z, PHI, THETA, PSI, DX, DY, DZ, DPHI, DTHETA, DPSI, BETA_ROLL, BETA_PITCH, OMEGA,
       A1, B1, GOVERNOR };

typedef struct {
  double Iyy, Izz, Ir, m, g, rho, R, c, a, B, Cd0, hr, lr, R_T, c_T, a_T, L_T, K_Omega;
  double K_theta0, K_theta0T, K_throttle, If, R1, R2, L1, L2, L3, L4, L5, Sx, Sy, Sz;
  double I_beta, k_beta, K_mu, h_T, K_P, K_I, Omega;
} Vehicle;

typedef struct {
  double x_roll, x_pitch, x_yaw, x_collective, x_throttle;
} Inputs;

/* Factors of parameters, and those of a held input: computed once. */
typedef struct {
  double b, lift, area, drag_torque, scale_torque, lift_torque, half_B2, quarter_B2, reaction;
  double tail_b, tail_lift, tail_area, bar, stick, mix_beta, mix_stick;
  double Iyy, Izz, per_Iyy, per_Izz, per_m, per_Ir, g, hr, lr, L_T, Sx, Sy, Sz, drag;
  double K_theta0, K_theta0T, K_throttle;
  double flap, turn, back, back_lift, k_beta, h_T, K_P, K_I, per_K_P, Omega, K_Omega;
  double tail_drag, tail_scale, tail_torque;
} Factors;

static Factors factors(const Vehicle *p) {
  double sigma = 2 * p->c / (M_PI * p->R), sigma_T = 2 * p->c_T / (M_PI * p->R_T);
  double B2 = p->B * p->B, B3 = B2 * p->B, R3 = p->R * p->R * p->R, RO = p->R_T * p->K_Omega;
  double half = 0.5 * p->a * sigma, half_T = 0.5 * p->a_T * sigma_T;
  double scale = p->rho * M_PI * R3;
  double paddles = p->R2 * p->R2 * p->R2 * p->R2 - p->R1 * p->R1 * p->R1 * p->R1;
  double link = 1 / (p->L1 * (p->L2 + p->L3));
  return (Factors){
      .b = half * 0.5 * B2 * p->R, .lift = half * B3 / 3 * p->R * p->R,
      .area = p->rho * M_PI * p->R * p->R,
      .drag_torque = scale * sigma * p->Cd0 / 8 * p->R * p->R,
      .scale_torque = scale * half, .lift_torque = B3 / 3 * p->R,
      .half_B2 = 0.5 * B2, .quarter_B2 = 0.25 * B2, .reaction = p->Ir * p->K_throttle,
      .tail_b = half_T * 0.5 * B2 * RO, .tail_lift = half_T * B3 / 3 * RO * RO,
      .tail_area = p->rho * M_PI * p->R_T * p->R_T,
      .bar = p->rho * p->a * p->c * paddles / (8 * p->If), .stick = 1 / p->L5,
      .mix_beta = link * p->L2 * p->L4, .mix_stick = link * p->L3,
      .Iyy = p->Iyy, .Izz = p->Izz, .per_Iyy = 1 / p->Iyy, .per_Izz = 1 / p->Izz,
      .per_m = 1 / p->m, .per_Ir = 1 / p->Ir, .g = p->g, .hr = p->hr, .lr = p->lr, .L_T = p->L_T,
      .Sx = p->Sx, .Sy = p->Sy, .Sz = p->Sz, .drag = 0.5 * p->rho / p->m,
      .flap = p->rho * p->a * p->c * R3 * p->R / p->I_beta / 16 * B2 * B2,
      .turn = 0.5 * p->k_beta / p->I_beta,
      .back = 4 * p->K_mu / (p->R * p->R * B2 * B2), .back_lift = 2.0 / 3 * B3 * p->R,
      .k_beta = p->k_beta, .h_T = p->h_T, .K_P = p->K_P, .K_I = p->K_I, .per_K_P = 1 / p->K_P,
      .Omega = p->Omega, .K_Omega = p->K_Omega,
      .tail_drag = p->rho * M_PI * p->R_T * p->R_T * p->R_T * sigma_T * p->Cd0 / 8 * RO * RO,
      .tail_scale = p->rho * M_PI * p->R_T * p->R_T * p->R_T * half_T, .tail_torque = B3 / 3 * RO,
      .K_theta0 = p->K_theta0, .K_theta0T = p->K_theta0T, .K_throttle = p->K_throttle,
  };
}

/* The root v of 2 v s = T0 - b v with the flow s of aerodynamics.py, by plain Newton steps from above. */
static inline double induced_velocity(double V2, double W, double T0, double b) {
  double sign = T0 < 0 ? -1.0 : 1.0, c = sign * W, t = sign * T0, q = 2 * c + b;
  double root = sqrt(q * q + 8 * t) + REST;
  double axial = q > 0 ? 2 * t / (fabs(q) + root) : 0.25 * (root - q);
  double edgewise = t / (2 * sqrt(V2 + REST * REST) + b + REST);
  double x = axial < edgewise ? axial : edgewise;
  double back = b - 2 * c, inside = back * back - 8 * t;
  int there = (back > 0) & (inside > 0);
  double windmill = 2 * t / (fabs(back) + sqrt(there ? inside : 0) + REST);
  x = there & (2.2 * windmill < -c) & (windmill < x) ? windmill : x;
#pragma GCC unroll 8
  for (int i = 0; i < NEWTON; i++) {
    double below = -c - 0.5 * x, above = 2.2 * x + c, product = below * above;
    double in = product > 0 ? product : 0, din = product > 0 ? 2.2 * below - 0.5 * above : 0;
    double ratio = in / (x * x + 5.8 * V2 + REST * REST), w = c + x;
    double s2 = V2 + w * w + 0.37 * ratio * in + REST * REST, s = sqrt(s2);
    double ds2 = 2 * w + 0.74 * ratio * (din - x * ratio);
    x -= s * (2 * x * s + b * x - t) / (2 * s2 + x * ds2 + b * s);
  }
  return sign * x;
}

/* Sine and cosine of one argument side by side become a sincos, which is not vectorised: these are
   kept apart, and gcc takes the vectorised ones of its library. */
__attribute__((noinline)) static void sines(const double *restrict x, double *restrict y) {
  for (int l = 0; l < 3 * LANES; l++) y[l] = sin(x[l]);
}

__attribute__((noinline)) static void cosines(const double *restrict x, double *restrict y) {
  for (int l = 0; l < 3 * LANES; l++) y[l] = cos(x[l]);
}

static inline void field(const Factors *p, const Inputs *u, const double Ixx[LANES],
                         double per_Ixx[LANES], double s[STATES][LANES], double f[STATES][LANES]) {
  double sn[3][LANES], cs[3][LANES];
  sines(s[PHI], sn[0]);
  cosines(s[PHI], cs[0]);
  double theta0 = p->K_theta0 * u->x_collective, theta0T = p->K_theta0T * u->x_yaw;
  for (int l = 0; l < LANES; l++) {
    double sphi = sn[0][l], sth = sn[1][l], spsi = sn[2][l];
    double cphi = cs[0][l], cth = cs[1][l], cpsi = cs[2][l];
    double dx = s[DX][l], dy = s[DY][l], dz = s[DZ][l], Omega = s[OMEGA][l];
    double dphi = s[DPHI][l], dtheta = s[DTHETA][l], dpsi = s[DPSI][l];
    double ahead = dx * cpsi + dy * spsi, aside = dy * cpsi - dx * spsi;
    double below = ahead * sth - dz * cth;
    double ub = ahead * cth + dz * sth, vb = aside * cphi + below * sphi;
    double wb = below * cphi - aside * sphi;
    double P = dphi - dpsi * sth, Q = dtheta * cphi + dpsi * cth * sphi;
    double R = dpsi * cth * cphi - dtheta * sphi;

    double roll = p->mix_stick * u->x_roll + p->mix_beta * s[BETA_ROLL][l];
    double pitch = p->mix_stick * u->x_pitch + p->mix_beta * s[BETA_PITCH][l];
    double a1 = s[A1][l], b1 = s[B1][l];
    double uh = ub - p->hr * Q, vh = vb + p->hr * P - p->lr * R;
    double W = -(wb + p->lr * Q) - uh * a1 + vh * b1;
    double edgewise = uh * (pitch - a1) - vh * (roll - b1), b = p->b * Omega;
    double T0 = p->lift * theta0 * Omega * Omega + b * edgewise - b * W;
    double vi = induced_velocity(uh * uh + vh * vh, W, T0, b), inflow = W + vi;
    double T = p->area * (T0 - b * vi);
    double lifting = p->lift_torque * Omega * theta0 - p->half_B2 * inflow;
    double torque = p->drag_torque * Omega * Omega +
                    p->scale_torque * inflow * (lifting + p->quarter_B2 * edgewise);

    double ut = ub - p->h_T * Q, wt = wb + p->L_T * Q;
    double Wt = p->L_T * R - vb - p->h_T * P, bt = p->tail_b * Omega;
    double Tt0 = p->tail_lift * theta0T * Omega * Omega - bt * Wt;
    double vt = induced_velocity(ut * ut + wt * wt, Wt, Tt0, bt), through = Wt + vt;
    double Tt = p->tail_area * (Tt0 - bt * vt);
    double tail_lifting = p->tail_torque * Omega * theta0T - p->half_B2 * through;
    double Qt = p->tail_drag * Omega * Omega + p->tail_scale * through * tail_lifting;

    double error = u->x_throttle * p->Omega - Omega, freely = p->K_P * error + s[GOVERNOR][l];
    double throttle = freely < 0 ? 0 : (freely > 1 ? 1 : freely);
    double stiffness = p->k_beta + T * p->hr, aside_T = T * b1;
    double Mroll = stiffness * b1 - p->h_T * Tt;
    double Mpitch = stiffness * a1 - T * p->lr;
    double Myaw = p->L_T * Tt + p->reaction * throttle - p->K_Omega * Qt - p->lr * aside_T;
    double dP = per_Ixx[l] * (Mroll - (p->Izz - p->Iyy) * Q * R);
    double dQ = p->per_Iyy * (Mpitch - (Ixx[l] - p->Izz) * R * P);
    double dR = p->per_Izz * (Myaw - (p->Iyy - Ixx[l]) * P * Q);
    double turn = dQ * sphi + dR * cphi + dphi * dtheta + dpsi * dtheta * sth;
    double ddpsi = turn / cth;

    double pull = p->per_m * T, factor = p->drag * sqrt(ub * ub + vb * vb + wb * wb);
    double fu = factor * p->Sx * ub + p->per_m * T * a1;
    double fv = factor * p->Sy * vb - p->per_m * (aside_T - Tt), fw = factor * p->Sz * wb;
    double across = fv * cphi - fw * sphi, under = fv * sphi + fw * cphi;
    double along = fu * cth + under * sth;

    f[X][l] = dx, f[Y][l] = dy, f[Z][l] = dz;
    f[PHI][l] = dphi, f[THETA][l] = dtheta, f[PSI][l] = dpsi;
    f[DX][l] = -pull * (cphi * sth * cpsi + sphi * spsi) - (along * cpsi - across * spsi);
    f[DY][l] = -pull * (cphi * sth * spsi - sphi * cpsi) - (along * spsi + across * cpsi);
    f[DZ][l] = pull * cphi * cth - p->g - (fu * sth - under * cth);
    f[DPHI][l] = dP + ddpsi * sth + dpsi * dtheta * cth;
    f[DTHETA][l] = dQ * cphi - dR * sphi - dphi * dpsi * cth;
    f[DPSI][l] = ddpsi;
    f[BETA_ROLL][l] = p->bar * Omega * (p->stick * u->x_roll - s[BETA_ROLL][l]) - P;
    f[BETA_PITCH][l] = p->bar * Omega * (p->stick * u->x_pitch - s[BETA_PITCH][l]) - Q;
    f[OMEGA][l] = p->K_throttle * throttle - p->per_Ir * (torque + p->K_Omega * Qt);
    double per_Omega = Omega / (Omega * Omega + REST), k = p->flap * Omega;
    double back_lift = p->back_lift * Omega * theta0 - p->half_B2 * inflow;
    double back = p->back * back_lift / (Omega * Omega + REST), around = p->turn * per_Omega;
    f[A1][l] = k * (pitch + back * uh - a1) + around * b1 - Q;
    f[B1][l] = k * (roll - back * vh - b1) - around * a1 - P;
    f[GOVERNOR][l] = p->K_I * (error + p->per_K_P * (throttle - freely));
  }
}

/* Sum of roll^2 over N samples for each of n vehicles, from one start; RK4, the inputs held. */
void run(const Vehicle *vehicle, const double *Ixx, const double *start, const Inputs *u,
         double *cost, size_t n, size_t N, double dt, int substeps) {
  Factors p = factors(vehicle);
  double h = dt / substeps;
  for (size_t v = 0; v < n; v += LANES) {
    double x[STATES][LANES], c[LANES] = {0}, I[LANES], per_I[LANES];
    for (int l = 0; l < LANES; l++) I[l] = Ixx[v + l], per_I[l] = 1 / I[l];
    for (int i = 0; i < STATES; i++)
      for (int l = 0; l < LANES; l++) x[i][l] = start[i];
    for (size_t k = 0; k < N; k++) {
      for (int l = 0; l < LANES; l++) c[l] += x[PHI][l] * x[PHI][l];
      if (k == N - 1) break;
      for (int sub = 0; sub < substeps; sub++) {
        double w[STATES][LANES], f[STATES][LANES], sum[STATES][LANES] = {{0}};
        for (int i = 0; i < STATES; i++)
          for (int l = 0; l < LANES; l++) w[i][l] = x[i][l];
        for (int stage = 0; stage < 4; stage++) {
          field(&p, &u[k], I, per_I, w, f);
          double weight = (stage == 1 || stage == 2) ? 2.0 : 1.0;
          double ahead = (stage == 2) ? h : 0.5 * h;
          for (int i = 0; i < STATES; i++)
            for (int l = 0; l < LANES; l++) {
              sum[i][l] += weight * f[i][l];
              w[i][l] = x[i][l] + ahead * f[i][l];
            }
        }
        for (int i = 0; i < STATES; i++)
          for (int l = 0; l < LANES; l++) x[i][l] += h / 6.0 * sum[i][l];
      }
    }
    for (int l = 0; l < LANES; l++) cost[v + l] = c[l];
  }
}
