/* Two tanks as an FMU for model exchange, by FMI 2 or 3. The outflow of a tank is a sqrt(level). */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#if FMI == 3
#include "fmi3Functions.h"
#define OK fmi3OK
#define DISCARD fmi3Discard
#define ERROR fmi3Error
#define FATAL fmi3Fatal
typedef fmi3Status status;
typedef fmi3ValueReference reference;
typedef fmi3Instance instance;
#define IN(name) fmi3##name
#else
#include "fmi2Functions.h"
#define OK fmi2OK
#define DISCARD fmi2Discard
#define ERROR fmi2Error
#define FATAL fmi2Fatal
typedef fmi2Status status;
typedef fmi2ValueReference reference;
typedef fmi2Component instance;
#define IN(name) fmi2##name
#endif

/* References: 0, 1 the levels; 2, 3 their rates; 4 pump; 5 leak, an input; 6 flow; 7 total; 8 area, 9 outlet, 10 drift:
   parameters; 11 loss: local; 12 the discrete one. */
enum { REALS = 13 };
typedef struct {
    double reals[REALS], time;
    int schedules, initialised;
    char name[80];
#if FMI == 3
    fmi3LogMessageCallback log;
#else
    fmi2CallbackLogger log;
#endif
} tanks;

static int mistakes; /* evaluations that were wrong: a static variable of the library */

static void say(tanks *t, status s, const char *text)
{
#if FMI == 3
    t->log(NULL, s, "logStatusError", text);
#else
    t->log(NULL, t->name, s, "logStatusError", text);
#endif
}

static status evaluate(tanks *t)
{
    double *r = t->reals;
    double upper, lower;
    if (r[0] < 0 || r[1] < 0) { say(t, DISCARD, "a level is negative"); return DISCARD; }
    if (r[0] > 1e5) { mistakes++; say(t, ERROR, "a tank overflows"); return ERROR; }
    if (r[0] > 1e4) { say(t, FATAL, "the plant is lost"); return FATAL; }
    upper = r[9] * sqrt(r[0]);
    lower = r[9] * sqrt(r[1]);
    r[11] = 0.1 * r[0] * r[0];
    r[2] = (r[4] - upper) / r[8] + r[10] * t->time;
    r[3] = (upper - lower - r[5]) / r[8];
    r[6] = lower;
    r[7] = r[0] + r[1] + 0.1 * r[4];
    return OK;
}

static status get(tanks *t, const reference *which, size_t count, double *values)
{
    status found = evaluate(t);
    for (size_t i = 0; i < count; i++) values[i] = t->reals[which[i]];
    return found;
}

static status put(tanks *t, const reference *which, size_t count, const double *values)
{
    for (size_t i = 0; i < count; i++) t->reals[which[i]] = values[i];
    return OK;
}

static status slope(tanks *t, const reference *unknowns, size_t many, reference known, double seed, double *out)
{
    double *r = t->reals, one = 0.5 * r[9] / sqrt(r[known]);
    int first = known == 0;
    for (size_t i = 0; i < many; i++) {
        switch (unknowns[i]) {
        case 2: out[i] = first ? -one / r[8] : 0.0; break;
        case 3: out[i] = (first ? one : -one) / r[8]; break;
        case 6: out[i] = first ? 0.0 : one; break;
        case 7: out[i] = 1.0; break;
        default: say(t, ERROR, "no derivative of this variable"); return ERROR;
        }
        out[i] *= seed;
    }
    return OK;
}

static tanks *started(const char *name)
{
    tanks *t = calloc(1, sizeof *t);
    strncpy(t->name, name, sizeof t->name - 1);
    t->reals[0] = 1.0; t->reals[1] = 0.5; t->reals[4] = 1.0; t->reals[8] = 2.0; t->reals[9] = 1.0;
    return t;
}

#define C(x) ((tanks *)(x))
void IN(FreeInstance)(instance c) { free(c); }
status IN(Terminate)(instance c) { return OK; }
status IN(ExitInitializationMode)(instance c) { return OK; }
status IN(EnterContinuousTimeMode)(instance c) { C(c)->initialised = 1; return OK; }
status IN(SetTime)(instance c, double time) { C(c)->time = time; return OK; }
status IN(SetContinuousStates)(instance c, const double *x, size_t n) { memcpy(C(c)->reals, x, n * sizeof *x); return OK; }
status IN(GetContinuousStates)(instance c, double *x, size_t n) { memcpy(x, C(c)->reals, n * sizeof *x); return OK; }
status IN(GetNominalsOfContinuousStates)(instance c, double *x, size_t n) { x[0] = NOMINAL; x[1] = 1.0; return OK; }
static status rates(instance c, double *d, size_t n) { status s = evaluate(C(c)); memcpy(d, C(c)->reals + 2, n * sizeof *d); return s; }

#if FMI == 3
fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String path, fmi3Boolean v, fmi3Boolean l,
    fmi3InstanceEnvironment e, fmi3LogMessageCallback log)
{
    tanks *t;
    if (strcmp(token, "tanks")) return NULL;
    t = started(name);
    t->log = log;
    return t;
}
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean d, fmi3Float64 tol, fmi3Float64 start, fmi3Boolean e, fmi3Float64 stop)
{ C(c)->time = start; return OK; }
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *more, fmi3Boolean *ends, fmi3Boolean *n, fmi3Boolean *v, fmi3Boolean *has, fmi3Float64 *when)
{ *more = *ends = *n = *v = 0; *has = C(c)->schedules; *when = 3.0; return OK; }
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 *d, size_t n) { return rates(c, d, n); }
fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference *r, size_t n, fmi3Float64 *v, size_t nv) { return get(C(c), r, n, v); }
fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference *r, size_t n, const fmi3Float64 *v, size_t nv) { return put(C(c), r, n, v); }
fmi3Status fmi3SetBoolean(fmi3Instance c, const fmi3ValueReference *r, size_t n, const fmi3Boolean *v, size_t nv) { C(c)->schedules = v[0]; return OK; }
fmi3Status fmi3SetInt32(fmi3Instance c, const fmi3ValueReference *r, size_t n, const fmi3Int32 *v, size_t nv) { C(c)->reals[9] *= v[0]; return OK; }
fmi3Status fmi3SetString(fmi3Instance c, const fmi3ValueReference *r, size_t n, const fmi3String *v, size_t nv) { return strcmp(v[0], "plant") ? ERROR : OK; }
fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference *u, size_t nu, const fmi3ValueReference *k, size_t nk,
    const fmi3Float64 *seed, size_t ns, fmi3Float64 *out, size_t no)
{ return nu == no && nk == ns ? slope(C(c), u, nu, k[0], seed[0], out) : ERROR; }
#else
fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String path, const fmi2CallbackFunctions *f, fmi2Boolean v, fmi2Boolean l)
{
    tanks *t;
    if (type != fmi2ModelExchange || strcmp(guid, "tanks")) return NULL;
    t = started(name);
    t->log = f->logger;
    return t;
}
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean d, fmi2Real tol, fmi2Real start, fmi2Boolean e, fmi2Real stop) { C(c)->time = start; return OK; }
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return OK; }
fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *e)
{ memset(e, 0, sizeof *e); e->nextEventTimeDefined = C(c)->schedules; e->nextEventTime = 3.0; return OK; }
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real *d, size_t n) { return rates(c, d, n); }
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference *r, size_t n, fmi2Real *v) { return get(C(c), r, n, v); }
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference *r, size_t n, const fmi2Real *v) { return put(C(c), r, n, v); }
fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference *r, size_t n, const fmi2Boolean *v) { C(c)->schedules = v[0]; return OK; }
fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference *r, size_t n, const fmi2Integer *v) { C(c)->reals[9] *= v[0]; return OK; }
fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference *r, size_t n, const fmi2String *v) { return strcmp(v[0], "plant") ? ERROR : OK; }
fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference *u, size_t nu, const fmi2ValueReference *k, size_t nk,
    const fmi2Real *seed, fmi2Real *out)
{ return slope(C(c), u, nu, k[0], seed[0], out); }
#endif
