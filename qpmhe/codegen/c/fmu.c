/* The estimator as an FMI 2.0 unit for co-simulation: y and u in, the estimate out.
 *
 * A communication step takes the present inputs as one sample. It must have the length of the
 * sampling time. Missing components of y are NaN. */

#include "mhe.h"

#include <math.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif

/* What the standard's headers declare. */
typedef void *fmi2Component;
typedef void *fmi2ComponentEnvironment;
typedef void *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer, fmi2Boolean;
typedef char fmi2Char, fmi2Byte;
typedef const fmi2Char *fmi2String;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated }
    fmi2StatusKind;
typedef struct {
    void (*logger)(fmi2ComponentEnvironment, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
    void *(*allocateMemory)(size_t, size_t);
    void (*freeMemory)(void *);
    void (*stepFinished)(fmi2ComponentEnvironment, fmi2Status);
    fmi2ComponentEnvironment componentEnvironment;
} fmi2CallbackFunctions;

/* Value references, in the order of modelDescription.xml. */
enum {
    INITIAL = 0, Y = INITIAL + MHE_NX, U = Y + MHE_NY, STATE = U + MHE_NU,
    FILTERED = STATE + MHE_NX, COST = FILTERED + MHE_NX, CANDIDATE_COST, RESTORED_COST,
$reals    REALS,
    STATUS = 0, QPS$integers, INTEGERS
};

/* The sampling time, 1 for a model that is a map. */
#define STEP $step

typedef struct {
    mhe_estimator estimator;
    mhe_estimate estimate;
$members    fmi2Real reals[REALS];
    fmi2Integer integers[INTEGERS];
} mhe_memory;

typedef struct {
    mhe_memory memory;
    mhe_workspace workspace;
    fmi2CallbackFunctions callbacks;
    char name[128];
} mhe_unit;

static const fmi2Real mhe_start[MHE_SIZE(MHE_NX)] = {$start};

static fmi2Status mhe_refuse(const mhe_unit *unit, const char *message)
{
    if (unit->callbacks.logger)
        unit->callbacks.logger(unit->callbacks.componentEnvironment, unit->name, fmi2Error,
                               "logStatusError", "%s", message);
    return fmi2Error;
}

static void mhe_restart(mhe_unit *unit)
{
    mhe_memory *m = &unit->memory;
    mhe_real x0[MHE_NX];
    for (int j = 0; j < MHE_NX; j++) {
        x0[j] = (mhe_real)m->reals[INITIAL + j];
        m->reals[STATE + j] = m->reals[FILTERED + j] = m->reals[INITIAL + j];
    }
    mhe_reset(&m->estimator, &mhe_default_settings, x0);
$begin}

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

EXPORT fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid,
                                     fmi2String resources, const fmi2CallbackFunctions *callbacks,
                                     fmi2Boolean visible, fmi2Boolean logging)
{
    (void)resources; (void)visible; (void)logging;
    if (!callbacks || !callbacks->allocateMemory || !callbacks->freeMemory) return 0;
    if (type != fmi2CoSimulation || !guid || strcmp(guid, "$guid") != 0) {
        if (callbacks->logger)
            callbacks->logger(callbacks->componentEnvironment, name, fmi2Error, "logStatusError",
                              "expected co-simulation and the GUID $guid");
        return 0;
    }
    mhe_unit *unit = callbacks->allocateMemory(1, sizeof(mhe_unit));
    if (!unit) return 0;
    memset(unit, 0, sizeof *unit);
    unit->callbacks = *callbacks;
    if (name) strncpy(unit->name, name, sizeof unit->name - 1);
    memcpy(unit->memory.reals + INITIAL, mhe_start, sizeof(fmi2Real) * MHE_NX);
    mhe_restart(unit);
    return unit;
}

EXPORT void fmi2FreeInstance(fmi2Component c)
{
    if (c) ((mhe_unit *)c)->callbacks.freeMemory(c);
}

EXPORT fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t count,
                                      const fmi2String categories[])
{
    (void)c; (void)on; (void)count; (void)categories;
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance,
                                      fmi2Real tolerance, fmi2Real start, fmi2Boolean has_stop,
                                      fmi2Real stop)
{
    (void)c; (void)has_tolerance; (void)tolerance; (void)start; (void)has_stop; (void)stop;
    return fmi2OK;
}

EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c) { (void)c; return fmi2OK; }

EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    mhe_unit *unit = c;
    for (int j = 0; j < MHE_NX; j++)
        if (!isfinite(unit->memory.reals[INITIAL + j]))
            return mhe_refuse(unit, "the initial state is not finite");
    mhe_restart(unit);
    return fmi2OK;
}

EXPORT fmi2Status fmi2Terminate(fmi2Component c) { (void)c; return fmi2OK; }

EXPORT fmi2Status fmi2Reset(fmi2Component c)
{
    mhe_unit *unit = c;
    memset(&unit->memory, 0, sizeof unit->memory);
    memcpy(unit->memory.reals + INITIAL, mhe_start, sizeof(fmi2Real) * MHE_NX);
    mhe_restart(unit);
    return fmi2OK;
}

EXPORT fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference which[], size_t count,
                              fmi2Real values[])
{
    const mhe_unit *unit = c;
    for (size_t i = 0; i < count; i++) {
        if (which[i] >= REALS) return mhe_refuse(unit, "there is no such real variable");
        values[i] = unit->memory.reals[which[i]];
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference which[], size_t count,
                              const fmi2Real values[])
{
    mhe_unit *unit = c;
    for (size_t i = 0; i < count; i++) {
        if (which[i] >= STATE) return mhe_refuse(unit, "this real variable cannot be set");
        unit->memory.reals[which[i]] = values[i];
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference which[], size_t count,
                                 fmi2Integer values[])
{
    const mhe_unit *unit = c;
    for (size_t i = 0; i < count; i++) {
        if (which[i] >= INTEGERS) return mhe_refuse(unit, "there is no such integer variable");
        values[i] = unit->memory.integers[which[i]];
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean keep)
{
    mhe_unit *unit = c;
    mhe_memory *m = &unit->memory;
    mhe_real y[MHE_NY], u[MHE_SIZE(MHE_NU)] = {0};
    (void)time; (void)keep;
    if (!(fabs(step - STEP) <= 1e-6 * STEP))
        return mhe_refuse(unit, "the communication step differs from the sampling time, $step");
    for (int j = 0; j < MHE_NY; j++) y[j] = (mhe_real)m->reals[Y + j];
    for (int j = 0; j < MHE_NU; j++) {
        if (!isfinite(m->reals[U + j])) return mhe_refuse(unit, "an input u is not finite");
        u[j] = (mhe_real)m->reals[U + j];
    }
    mhe_update(&m->estimator, &unit->workspace, y, u, &m->estimate);
    for (int j = 0; j < MHE_NX; j++) {
        m->reals[STATE + j] = m->estimate.trajectory[m->estimate.length * MHE_NX + j];
        m->reals[FILTERED + j] = m->estimate.filtered[j];
    }
    m->reals[COST] = m->estimate.cost;
    m->reals[CANDIDATE_COST] = m->estimate.candidate_cost;
    m->reals[RESTORED_COST] = m->estimate.restored_cost;
    m->integers[STATUS] = m->estimate.status;
    m->integers[QPS] = m->estimate.qps;
$check    return fmi2OK;
}

EXPORT fmi2Status fmi2CancelStep(fmi2Component c)
{
    return mhe_refuse(c, "steps are not asynchronous");
}

EXPORT fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    mhe_unit *unit = c;
    if (!*state) *state = unit->callbacks.allocateMemory(1, sizeof(mhe_memory));
    if (!*state) return mhe_refuse(unit, "there is no memory for a state");
    memcpy(*state, &unit->memory, sizeof(mhe_memory));
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    memcpy(&((mhe_unit *)c)->memory, state, sizeof(mhe_memory));
    return fmi2OK;
}

EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    if (*state) ((mhe_unit *)c)->callbacks.freeMemory(*state);
    *state = 0;
    return fmi2OK;
}

EXPORT fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size)
{
    (void)c; (void)state;
    *size = sizeof(mhe_memory);
    return fmi2OK;
}

EXPORT fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[],
                                        size_t size)
{
    if (size < sizeof(mhe_memory)) return mhe_refuse(c, "too few bytes for a state");
    memcpy(bytes, state, sizeof(mhe_memory));
    return fmi2OK;
}

EXPORT fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size,
                                          fmi2FMUstate *state)
{
    mhe_unit *unit = c;
    if (size < sizeof(mhe_memory)) return mhe_refuse(unit, "too few bytes for a state");
    if (!*state) *state = unit->callbacks.allocateMemory(1, sizeof(mhe_memory));
    if (!*state) return mhe_refuse(unit, "there is no memory for a state");
    memcpy(*state, bytes, sizeof(mhe_memory));
    ((mhe_memory *)*state)->estimator.settings = &mhe_default_settings; /* of this process */
    return fmi2OK;
}

/* What the standard has and this unit does not: there are no such variables. */
#define ABSENT(name, ...) \
    EXPORT fmi2Status name(fmi2Component c, const fmi2ValueReference which[], size_t count, \
                           __VA_ARGS__) \
    { \
        (void)which; \
        return count ? mhe_refuse(c, #name ": there is no such variable") : fmi2OK; \
    }

ABSENT(fmi2GetBoolean, fmi2Boolean values[])
ABSENT(fmi2GetString, fmi2String values[])
ABSENT(fmi2SetInteger, const fmi2Integer values[])
ABSENT(fmi2SetBoolean, const fmi2Boolean values[])
ABSENT(fmi2SetString, const fmi2String values[])
ABSENT(fmi2SetRealInputDerivatives, const fmi2Integer order[], const fmi2Real values[])
ABSENT(fmi2GetRealOutputDerivatives, const fmi2Integer order[], fmi2Real values[])
ABSENT(fmi2GetDirectionalDerivative, const fmi2ValueReference known[], size_t inputs,
       const fmi2Real seed[], fmi2Real values[])

#define NO_STATUS(name, type) \
    EXPORT fmi2Status name(fmi2Component c, fmi2StatusKind kind, type *value) \
    { \
        (void)c, (void)kind, (void)value; \
        return fmi2Discard; /* no step is ever pending */ \
    }

NO_STATUS(fmi2GetStatus, fmi2Status)
NO_STATUS(fmi2GetRealStatus, fmi2Real)
NO_STATUS(fmi2GetIntegerStatus, fmi2Integer)
NO_STATUS(fmi2GetBooleanStatus, fmi2Boolean)
NO_STATUS(fmi2GetStringStatus, fmi2String)
