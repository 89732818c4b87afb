/* A window's problem in acados, by its C interface, compiled with the model's functions.

N stages with the states x(i) and the disturbances w(i) as controls,
    x(i+1) = f(x(i), u(i)) + w(i),
with the linear outputs C x as a linear least-squares cost of v, w and, at the first stage, of
x(0) - prior. u(i) are acados' parameters. The matrices are column-major. Bounds of states and
functions g(x) <= 0 are hard, or have slacks with the cost linear s + quadratic s^2; acados
minimises half of J. */

#include <stdlib.h>
#include <string.h>

#include "acados_c/ocp_nlp_interface.h"

/* CasADi's functions, which stand above: window_step of (x, w, u) to f(x, u) + w, and
window_step_jac, which also has the transposed Jacobian by (w, x). Likewise window_rows of
(x, w, z, u) to g(x), where z is empty, and window_rows_jac. */

typedef struct {
    int stages, n, p, m;
    int bounded, controls;  /* bounded states and disturbances a stage */
    int bounded_last;       /* bounded states of the last stage */
    int rows;               /* functions a stage */
    int soft;               /* whether bounds of states and functions have slacks */
    double linear, quadratic;
    int capped;             /* one QP, or converged */
    double smallest;        /* a step that is taken for convergence */
} Sizes;

/* All that a window has: what goes in, and what comes out. */
typedef struct {
    double *prior, *measurements, *inputs, *lower, *upper;
    double *states, *disturbances;
} Arrays;

typedef struct {
    Sizes sizes;
    Arrays arrays;
    ocp_nlp_plan_t *plan;
    ocp_nlp_config *config;
    ocp_nlp_dims *dims;
    ocp_nlp_in *in;
    ocp_nlp_out *out;
    void *options;
    ocp_nlp_solver *solver;
    external_function_external_param_casadi *steps, *slopes, *rows, *row_slopes;
    double *reference;
    const double **arguments;
    double **results, *work;
    int *counts;
} Window;

static int bounded(const Sizes *s, int i)
{
    return i < s->stages ? s->bounded : s->bounded_last;
}

static void dimensions(Window *one)
{
    const Sizes *s = &one->sizes;
    int N = s->stages, last = N + 1, zero = 0;
    int *all = calloc((size_t)5 * last, sizeof(int));
    int *nx = all, *nu = nx + last, *none = nu + last, *np = none + last, *ns = np + last;
    for (int i = 0; i <= N; i++) {
        nx[i] = s->n;
        ns[i] = s->soft ? bounded(s, i) + s->rows : 0;
        nu[i] = i < N ? s->n : 0;
        np[i] = s->m;
    }
    ocp_nlp_dims_set_opt_vars(one->config, one->dims, "nx", nx);
    ocp_nlp_dims_set_opt_vars(one->config, one->dims, "nu", nu);
    ocp_nlp_dims_set_opt_vars(one->config, one->dims, "nz", none);
    ocp_nlp_dims_set_opt_vars(one->config, one->dims, "ns", ns);
    ocp_nlp_dims_set_opt_vars(one->config, one->dims, "np", np);
    ocp_nlp_dims_set_global(one->config, one->dims, "np_global", 0);
    ocp_nlp_dims_set_global(one->config, one->dims, "n_global_data", 0);
    for (int i = 0; i <= N; i++) {
        int ny = i == N ? 0 : i ? s->p + s->n : s->p + 2 * s->n;
        int nbx = bounded(s, i), nbu = i < N ? s->controls : 0, nh = s->rows;
        ocp_nlp_dims_set_constraints(one->config, one->dims, i, "nbx", &nbx);
        ocp_nlp_dims_set_constraints(one->config, one->dims, i, "nbu", &nbu);
        ocp_nlp_dims_set_constraints(one->config, one->dims, i, "ng", &zero);
        ocp_nlp_dims_set_constraints(one->config, one->dims, i, "nh", &nh);
        if (s->soft) {
            ocp_nlp_dims_set_constraints(one->config, one->dims, i, "nsbx", &nbx);
            ocp_nlp_dims_set_constraints(one->config, one->dims, i, "nsh", &nh);
        }
        ocp_nlp_dims_set_cost(one->config, one->dims, i, "ny", &ny);
    }
    free(all);
}

/* g(x) <= 0 at all stages, and the costs of slacks. */
static void inequalities(Window *one)
{
    const Sizes *s = &one->sizes;
    int many = s->rows + (s->bounded > s->bounded_last ? s->bounded : s->bounded_last);
    double *low = calloc(many, sizeof *low), *high = calloc(many, sizeof *high);
    double *linear = calloc(many, sizeof *linear), *quadratic = calloc(many, sizeof *quadratic);
    int *which = calloc(many, sizeof *which);
    external_function_opts options;
    external_function_opts_set_to_default(&options);
    options.external_workspace = true;
    for (int k = 0; k < many; k++) {
        low[k] = -ACADOS_INFTY;
        linear[k] = 0.5 * s->linear;
        quadratic[k] = s->quadratic;
        which[k] = k;
    }
    one->rows = calloc(s->stages + 1, sizeof *one->rows);
    one->row_slopes = calloc(s->stages + 1, sizeof *one->row_slopes);
    for (int i = 0; i <= s->stages; i++) {
        if (s->rows) {
            TAKE(one->rows + i, window_rows, external_param_casadi, &options);
            TAKE(one->row_slopes + i, window_rows_jac, external_param_casadi, &options);
            ocp_nlp_constraints_model_set_external_param_fun(
                one->config, one->dims, one->in, i, "nl_constr_h_fun", one->rows + i);
            ocp_nlp_constraints_model_set_external_param_fun(
                one->config, one->dims, one->in, i, "nl_constr_h_fun_jac", one->row_slopes + i);
            ocp_nlp_constraints_model_set(
                one->config, one->dims, one->in, one->out, i, "lh", low);
            ocp_nlp_constraints_model_set(
                one->config, one->dims, one->in, one->out, i, "uh", high);
        }
        if (s->soft) {
            ocp_nlp_constraints_model_set(
                one->config, one->dims, one->in, one->out, i, "idxsbx", which);
            ocp_nlp_constraints_model_set(
                one->config, one->dims, one->in, one->out, i, "idxsh", which);
            ocp_nlp_cost_model_set(one->config, one->dims, one->in, i, "zl", linear);
            ocp_nlp_cost_model_set(one->config, one->dims, one->in, i, "zu", linear);
            ocp_nlp_cost_model_set(one->config, one->dims, one->in, i, "Zl", quadratic);
            ocp_nlp_cost_model_set(one->config, one->dims, one->in, i, "Zu", quadratic);
        }
    }
    free(low);
    free(high);
    free(linear);
    free(quadratic);
    free(which);
}

/* The last stage has no cost of v and w: no measurement follows it. */
static void cost(Window *one, const double *const *first, const double *const *other)
{
    static const char *names[] = {"Vx", "Vu", "W"};
    for (int i = 0; i <= one->sizes.stages; i++) {
        double scaling = 1.0;
        ocp_nlp_cost_model_set(one->config, one->dims, one->in, i, "scaling", &scaling);
        for (int k = 0; k < 3 && i < one->sizes.stages; k++)
            ocp_nlp_cost_model_set(
                one->config, one->dims, one->in, i, names[k], (void *)(i ? other : first)[k]);
    }
}

static void model(Window *one)
{
    int N = one->sizes.stages;
    external_function_opts options;
    external_function_opts_set_to_default(&options);
    options.external_workspace = true;
    one->steps = calloc(N, sizeof *one->steps);
    one->slopes = calloc(N, sizeof *one->slopes);
    for (int i = 0; i < N; i++) {
        TAKE(one->steps + i, window_step, external_param_casadi, &options);
        TAKE(one->slopes + i, window_step_jac, external_param_casadi, &options);
        ocp_nlp_dynamics_model_set_external_param_fun(
            one->config, one->dims, one->in, i, "disc_dyn_fun", one->steps + i);
        ocp_nlp_dynamics_model_set_external_param_fun(
            one->config, one->dims, one->in, i, "disc_dyn_fun_jac", one->slopes + i);
    }
    int args, res, iw, w;
    window_step_work(&args, &res, &iw, &w);
    one->arguments = calloc(args + 1, sizeof *one->arguments);
    one->results = calloc(res + 1, sizeof *one->results);
    one->counts = calloc(iw + 1, sizeof *one->counts);
    one->work = calloc(w + 1, sizeof *one->work);
}

static void set_bounds(Window *one)
{
    const Sizes *s = &one->sizes;
    for (int i = 0; i <= s->stages && bounded(s, i); i++) {
        ocp_nlp_constraints_model_set(one->config, one->dims, one->in, one->out, i, "lbx",
                                      one->arrays.lower + i * s->bounded);
        ocp_nlp_constraints_model_set(one->config, one->dims, one->in, one->out, i, "ubx",
                                      one->arrays.upper + i * s->bounded);
    }
}

/* A window with these arrays, which stay the caller's; NULL if acados refuses it. */
void *window_make(const Sizes *sizes, const Arrays *arrays, const double *const *first,
                  const double *const *other, const int *states, const int *controls,
                  const double *w_lower, const double *w_upper)
{
    Window *one = calloc(1, sizeof *one);
    one->sizes = *sizes;
    one->arrays = *arrays;
    int N = sizes->stages;
    ocp_nlp_plan_t *plan = one->plan = ocp_nlp_plan_create(N);
    plan->nlp_solver = sizes->capped ? SQP_RTI : SQP;
    plan->ocp_qp_solver_plan.qp_solver = PARTIAL_CONDENSING_HPIPM;
    plan->relaxed_ocp_qp_solver_plan.qp_solver = PARTIAL_CONDENSING_HPIPM;
    plan->regularization = NO_REGULARIZE;
    plan->globalization = FIXED_STEP;
    for (int i = 0; i <= N; i++) {
        plan->nlp_cost[i] = LINEAR_LS;
        plan->nlp_constraints[i] = BGH;
    }
    for (int i = 0; i < N; i++) {
        plan->nlp_dynamics[i] = DISCRETE_MODEL;
        plan->sim_solver_plan[i].sim_solver = INVALID_SIM_SOLVER;
    }
    one->config = ocp_nlp_config_create(*plan);
    one->dims = ocp_nlp_dims_create(one->config);
    dimensions(one);
    one->in = ocp_nlp_in_create(one->config, one->dims);
    one->out = ocp_nlp_out_create(one->config, one->dims);
    model(one);
    cost(one, first, other);
    for (int i = 0; i <= N; i++) {
        if (bounded(sizes, i))
            ocp_nlp_constraints_model_set(
                one->config, one->dims, one->in, one->out, i, "idxbx", (void *)states);
        if (i < N && sizes->controls) {
            ocp_nlp_constraints_model_set(
                one->config, one->dims, one->in, one->out, i, "idxbu", (void *)controls);
            ocp_nlp_constraints_model_set(
                one->config, one->dims, one->in, one->out, i, "lbu", (void *)w_lower);
            ocp_nlp_constraints_model_set(
                one->config, one->dims, one->in, one->out, i, "ubu", (void *)w_upper);
        }
    }
    set_bounds(one);
    inequalities(one);
    one->options = ocp_nlp_solver_opts_create(one->config, one->dims);
    /* The fastest of HPIPM's modes leaves the multipliers of the dynamics undetermined, so that no
       residual tells when SQP has converged; the step does. With hard nonlinear rows, SQP does not
       end in one window of a benchmark if its QPs start at all of the solution before; without its
       slacks and multipliers they take as long. */
    int most = 100, warm = sizes->rows ? 1 : 2;
    double complementarity = 1e-6;
    ocp_nlp_solver_opts_set(one->config, one->options, "qp_hpipm_mode", (void *)"SPEED_ABS");
    ocp_nlp_solver_opts_set(one->config, one->options, "qp_cond_N", &N);
    ocp_nlp_solver_opts_set(one->config, one->options, "qp_warm_start", &warm);
    ocp_nlp_solver_opts_set(one->config, one->options, "qp_tol_comp", &complementarity);
    if (!sizes->capped) {
        double smallest = sizes->smallest;
        ocp_nlp_solver_opts_set(one->config, one->options, "max_iter", &most);
        ocp_nlp_solver_opts_set(one->config, one->options, "tol_min_step_norm", &smallest);
    }
    one->solver = ocp_nlp_solver_create(one->config, one->dims, one->options, one->in);
    one->reference = calloc(sizes->p + 2 * sizes->n, sizeof(double));
    if (ocp_nlp_precompute(one->solver, one->in, one->out))
        return NULL;
    return one;
}

/* Shift the solution by a stage; the model predicts the last state. */
static void shift(Window *one)
{
    const Sizes *s = &one->sizes;
    int N = s->stages, n = s->n;
    double *x = one->arrays.states, *w = one->arrays.disturbances;
    memmove(x, x + n, sizeof(double) * N * n);
    memmove(w, w + n, sizeof(double) * (N - 1) * n);
    memset(w + (N - 1) * n, 0, sizeof(double) * n);
    one->arguments[0] = x + (N - 1) * n;
    one->arguments[1] = w + (N - 1) * n;
    one->arguments[2] = one->arrays.inputs + (N - 1) * s->m;
    one->results[0] = x + N * n;
    window_step(one->arguments, one->results, one->counts, one->work, 0);
}

/* Solve, from the arrays' states and disturbances, or from the solution before; acados' status. */
int window_solve(Window *one, int continues)
{
    const Sizes *s = &one->sizes;
    Arrays *a = &one->arrays;
    if (continues)
        shift(one);
    ocp_nlp_set_all(one->solver, one->in, one->out, "x", a->states);
    ocp_nlp_set_all(one->solver, one->in, one->out, "u", a->disturbances);
    memcpy(one->reference + s->p + s->n, a->prior, sizeof(double) * s->n);
    for (int i = 0; i < s->stages; i++) {
        memcpy(one->reference, a->measurements + i * s->p, sizeof(double) * s->p);
        ocp_nlp_cost_model_set(one->config, one->dims, one->in, i, "yref", one->reference);
        if (s->m)
            ocp_nlp_in_set(one->config, one->dims, one->in, i, "parameter_values",
                           a->inputs + i * s->m);
    }
    set_bounds(one);
    int status = ocp_nlp_solve(one->solver, one->in, one->out);
    ocp_nlp_get_all(one->solver, one->in, one->out, "x", a->states);
    ocp_nlp_get_all(one->solver, one->in, one->out, "u", a->disturbances);
    return status;
}

void window_free(Window *one)
{
    for (int i = 0; i < one->sizes.stages; i++) {
        external_function_external_param_casadi_free(one->steps + i);
        external_function_external_param_casadi_free(one->slopes + i);
    }
    for (int i = 0; one->sizes.rows && i <= one->sizes.stages; i++) {
        external_function_external_param_casadi_free(one->rows + i);
        external_function_external_param_casadi_free(one->row_slopes + i);
    }
    ocp_nlp_solver_destroy(one->solver);
    ocp_nlp_solver_opts_destroy(one->options);
    ocp_nlp_in_destroy(one->in);
    ocp_nlp_out_destroy(one->out);
    ocp_nlp_dims_destroy(one->dims);
    ocp_nlp_config_destroy(one->config);
    ocp_nlp_plan_destroy(one->plan);
    free(one->steps);
    free(one->slopes);
    free(one->rows);
    free(one->row_slopes);
    free(one->reference);
    free(one->arguments);
    free(one->results);
    free(one->counts);
    free(one->work);
    free(one);
}
