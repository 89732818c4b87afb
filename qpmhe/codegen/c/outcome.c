/* What a search has found so far. */

#define CONSTRAINED (MHE_STAGE_ROWS > 0)

/* What becomes of a QP. */
enum { SOLVED, STOPPED, UNCONSTRAINED, FAILED, EXCLUDED, NEARLY };

typedef struct {
    mhe_trial *candidate, *best, *spare, *other; /* best may be the candidate */
    int outside; /* the candidate misses rows: as a trial, it has no finite cost */
    int events, qps, iterations, corrections, nearest_points, rows_dropped;
    int unreached;  /* no trajectory in the sets is known, and the missed rows are to be named */
    int unsolved;   /* the last QPs that were not solved to the tolerance */
    int followed;   /* the next step starts from a surrogate's minimiser */
    real restored_cost; /* of the trajectory into which the candidate was restored */
    real damping;   /* with which a search for a shorter step begins, at least */
    real present, growth; /* that of the present QP, and what it is multiplied with next */
    int has_seen;   /* its scale is known */
    real radius;    /* of the region of steps, infinite where there is none */
    real tried, expected; /* length of the last step tried, and the decrease of J promised for it */
    int is_shortened; /* it is not that of the QP */
    int rolled_out; /* the candidate's cost is that of its roll-out */
    int is_curved;   /* the last whole step leaves the sets, as curvature may have it */
    int factorised; /* the QP's matrix, with its active rows, is in the panels */
} mhe_outcome;

/* Other reasons for the end of a sequence than its cap, and what no longer holds in another one. */
#define ENDS (MHE_CONVERGED | MHE_NO_DECREASE | MHE_SOLVER_FAILED | MHE_MODEL_FAILED | MHE_TIME_UP)
#define OUTDATED (MHE_CONVERGED | MHE_NO_DECREASE | MHE_SOLVER_FAILED | MHE_CAP_REACHED)

/* Cost of the best trajectory as a trial. */
static real mhe_best_cost(const mhe_outcome *o)
{
    return o->outside && o->best == o->candidate ? INFINITY : o->best->cost;
}

/* The cost below which a trial is better than the best one. */
static real mhe_target(const mhe_outcome *o)
{
    const real cost = mhe_best_cost(o);
    return isfinite(cost) ? cost - MHE_ROUNDING * fabs(cost) : INFINITY;
}
