/* Steps of acados' implicit integrator with Radau's nodes, compiled with the model's functions.

Those stand above, of (x, x', u, z, t): residual of f(x, z, u) - x' and of the algebraic equations;
the same with its Jacobians by x, x' and z; and the Jacobians by x, x', u and z alone. */

#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#include "acados_c/sim_interface.h"

typedef struct {
    int n, k, m, steps, iterations;
    int reuses;  /* one Jacobian for all iterations of a sample */
    double dt, tolerance;
} Sizes;

typedef struct {
    Sizes sizes;
    sim_config *config;
    void *dims, *options;
    sim_in *in;
    sim_out *out;
    sim_solver *solver;
    external_function_casadi residual, with_slopes, slopes;
    double *rates, *guess;
} Integrator;

void *integrator_make(const Sizes *sizes, const double *guess)
{
    Integrator *one = calloc(1, sizeof *one);
    one->sizes = *sizes;
    int n = sizes->n, zero = 0, stages = 3;
    external_function_opts plain;
    external_function_opts_set_to_default(&plain);
    TAKE(&one->residual, irk_residual, casadi, &plain);
    TAKE(&one->with_slopes, irk_with_slopes, casadi, &plain);
    TAKE(&one->slopes, irk_slopes, casadi, &plain);
    sim_solver_plan_t plan = {IRK};
    one->config = sim_config_create(plan);
    one->dims = sim_dims_create(one->config);
    sim_dims_set(one->config, one->dims, "nx", &n);
    sim_dims_set(one->config, one->dims, "nu", &sizes->m);
    sim_dims_set(one->config, one->dims, "nz", &sizes->k);
    sim_dims_set(one->config, one->dims, "np", &zero);
    one->options = sim_opts_create(one->config, one->dims);
    sim_collocation_type nodes = GAUSS_RADAU_IIA;
    bool yes = true, no = false, reuses = sizes->reuses;
    double tolerance = sizes->tolerance, dt = sizes->dt;
    int iterations = sizes->iterations, steps = sizes->steps;
    sim_opts_set(one->config, one->options, "newton_iter", &iterations);
    sim_opts_set(one->config, one->options, "newton_tol", &tolerance);
    sim_opts_set(one->config, one->options, "collocation_type", &nodes);
    sim_opts_set(one->config, one->options, "num_stages", &stages);
    sim_opts_set(one->config, one->options, "num_steps", &steps);
    sim_opts_set(one->config, one->options, "jac_reuse", &reuses);
    sim_opts_set(one->config, one->options, "sens_forw", &yes);
    sim_opts_set(one->config, one->options, "sens_adj", &no);
    sim_opts_set(one->config, one->options, "sens_hess", &no);
    sim_opts_set(one->config, one->options, "sens_algebraic", &no);
    sim_opts_set(one->config, one->options, "output_z", &no);
    one->in = sim_in_create(one->config, one->dims);
    one->out = sim_out_create(one->config, one->dims);
    sim_in_set(one->config, one->dims, one->in, "T", &dt);
    one->config->model_set(one->in->model, "impl_ode_fun", &one->residual);
    one->config->model_set(one->in->model, "impl_ode_fun_jac_x_xdot_z", &one->with_slopes);
    one->config->model_set(one->in->model, "impl_ode_jac_x_xdot_u_z", &one->slopes);
    one->solver = sim_solver_create(one->config, one->dims, one->options, one->in);
    double *seed = calloc((size_t)n * (n + sizes->m), sizeof *seed);
    for (int i = 0; i < n; i++)
        seed[i * n + i] = 1.0;
    sim_in_set(one->config, one->dims, one->in, "S_forw", seed);
    free(seed);
    one->rates = calloc(n, sizeof *one->rates);
    one->guess = calloc(sizes->k + 1, sizeof *one->guess);
    memcpy(one->guess, guess, sizeof(double) * sizes->k);
    return sim_precompute(one->solver, one->in, one->out) ? NULL : one;
}

/* Next states (count, n) and column-major Jacobians by x; how many steps failed. Each starts at
the same stages: rates of zero, and the guess. */
int integrator_steps(Integrator *one, int count, const double *x, const double *u,
                     double *following, double *slopes)
{
    const Sizes *s = &one->sizes;
    int failed = 0;
    for (int i = 0; i < count; i++) {
        sim_in_set(one->config, one->dims, one->in, "x", (void *)(x + i * s->n));
        sim_in_set(one->config, one->dims, one->in, "u", (void *)(u + i * s->m));
        sim_solver_set(one->solver, "xdot", one->rates);
        sim_solver_set(one->solver, "z", one->guess);
        failed += sim_solve(one->solver, one->in, one->out) != 0;
        sim_out_get(one->config, one->dims, one->out, "xn", following + i * s->n);
        sim_out_get(one->config, one->dims, one->out, "Sx", slopes + i * s->n * s->n);
    }
    return failed;
}
