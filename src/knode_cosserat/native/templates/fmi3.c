/* $title: FMI 3.0 for co-simulation, around fmu.c. */
typedef void (*log_function)(void *environment, int status, const char *category, const char *message);
#include "fmu.c"

#include <stdbool.h>

typedef const char *string;

static void tell(const instance *each, const char *message) {
    if (each->logger) each->logger(each->environment, ERROR, "logStatusError", message);
}

/* A function of an instance. */
#define FUNCTION(name, ...) EXPORTED int fmi3##name(instance *each, ##__VA_ARGS__)
#define REFERENCES_OF(type) const uint32_t *references, size_t count, type *values, size_t size

EXPORTED string fmi3GetVersion(void) { return "3.0"; }

EXPORTED instance *fmi3InstantiateCoSimulation(string name, string token, string resources, bool visible, bool logging,
                                               bool has_events, bool returns_early, const uint32_t *intermediate,
                                               size_t count, void *environment, log_function logger, void *update) {
    (void)resources, (void)visible, (void)logging, (void)has_events, (void)returns_early, (void)intermediate;
    (void)count, (void)update;
    return instantiate(name, token, logger, environment);
}

EXPORTED instance *fmi3InstantiateModelExchange(string name, string token, string resources, bool visible, bool logging,
                                                void *environment, log_function logger) {
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)logger;
    return NULL;
}

EXPORTED instance *fmi3InstantiateScheduledExecution(string name, string token, string resources, bool visible,
                                                     bool logging, void *environment, log_function logger, void *update,
                                                     void *lock, void *unlock) {
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)logger;
    (void)update, (void)lock, (void)unlock;
    return NULL;
}

EXPORTED void fmi3FreeInstance(instance *each) { free(each); }

/* errors are logged always, and nothing else is */
FUNCTION(SetDebugLogging, bool logging, size_t count, const string *categories) {
    (void)logging, (void)count, (void)categories;
    return each ? OK : ERROR;
}

FUNCTION(EnterInitializationMode, bool has_tolerance, double tolerance, double start_time, bool has_stop,
         double stop_time) {
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop_time;
    return each && set_start_time(each, start_time) == OK ? initialize(each) : ERROR;
}

FUNCTION(ExitInitializationMode) { return each ? finish_initialization(each) : ERROR; }

FUNCTION(Terminate) { return each ? terminate(each) : ERROR; }

FUNCTION(Reset) {
    if (!each) return ERROR;
    restart(each);
    return OK;
}

FUNCTION(GetFloat64, REFERENCES_OF(double)) { return each ? get_numbers(each, references, count, values, size) : ERROR; }

FUNCTION(SetFloat64, REFERENCES_OF(const double)) {
    return each ? set_numbers(each, references, count, values, size) : ERROR;
}

FUNCTION(GetInt32, REFERENCES_OF(int32_t)) { return each ? get_result(each, references, count, values, size) : ERROR; }

FUNCTION(GetBoolean, REFERENCES_OF(bool)) {
    if (!each || size != count) return ERROR;
    for (size_t k = 0; k < count; k++) {
        if (is_settled(each, references[k]) != OK) return ERROR;
        values[k] = each->now.settled != 0;
    }
    return OK;
}

FUNCTION(SetBoolean, REFERENCES_OF(const bool)) {
    if (!each || size != count) return ERROR;
    for (size_t k = 0; k < count; k++)
        if (set_settled(each, references[k], values[k]) != OK) return ERROR;
    return OK;
}

/* Functions of variables that this FMU does not have: allowed without variables only. */
#define UNUSED(name, what, ...)                                      \
    FUNCTION(name, const uint32_t *references, size_t count, ##__VA_ARGS__) { \
        (void)references;                                            \
        return !each ? ERROR : count == 0 ? OK : refuse(each, what); \
    }
#define NO_VARIABLES(type, c)                                              \
    UNUSED(Get##type, "variables of type " #type, c *values, size_t size) \
    UNUSED(Set##type, "inputs of type " #type, const c *values, size_t size)
NO_VARIABLES(Float32, float)
NO_VARIABLES(Int8, int8_t)
NO_VARIABLES(UInt8, uint8_t)
NO_VARIABLES(Int16, int16_t)
NO_VARIABLES(UInt16, uint16_t)
NO_VARIABLES(UInt32, uint32_t)
NO_VARIABLES(Int64, int64_t)
NO_VARIABLES(UInt64, uint64_t)
NO_VARIABLES(String, string)
UNUSED(SetInt32, "inputs of type Int32", const int32_t *values, size_t size)
UNUSED(GetBinary, "binary variables", size_t *sizes_of, const uint8_t **values, size_t size)
UNUSED(SetBinary, "binary variables", const size_t *sizes_of, const uint8_t *const *values, size_t size)
UNUSED(GetClock, "clocks", bool *values)
UNUSED(SetClock, "clocks", const bool *values)
UNUSED(GetIntervalDecimal, "clocks", double *intervals, int *qualifiers)
UNUSED(GetIntervalFraction, "clocks", uint64_t *counters, uint64_t *resolutions, int *qualifiers)
UNUSED(GetShiftDecimal, "clocks", double *shifts)
UNUSED(GetShiftFraction, "clocks", uint64_t *counters, uint64_t *resolutions)
UNUSED(SetIntervalDecimal, "clocks", const double *intervals)
UNUSED(SetIntervalFraction, "clocks", const uint64_t *counters, const uint64_t *resolutions)
UNUSED(SetShiftDecimal, "clocks", const double *shifts)
UNUSED(SetShiftFraction, "clocks", const uint64_t *counters, const uint64_t *resolutions)
UNUSED(GetOutputDerivatives, "derivatives of outputs by time", const int32_t *orders, double *values, size_t size)

/* modes and functions of other kinds of FMU */
#define NO_MODE(name, what, ...) \
    FUNCTION(name, ##__VA_ARGS__) { return each ? refuse(each, what) : ERROR; }
NO_MODE(EnterEventMode, "event mode")
NO_MODE(EnterStepMode, "event mode")
NO_MODE(EvaluateDiscreteStates, "discrete states")
NO_MODE(UpdateDiscreteStates, "event mode", bool *a, bool *b, bool *c, bool *d, bool *e, double *next)
NO_MODE(ActivateModelPartition, "clocks", uint32_t reference, double time)
NO_MODE(EnterContinuousTimeMode, "model exchange")
NO_MODE(CompletedIntegratorStep, "model exchange", bool is_final, bool *has_event, bool *is_over)
NO_MODE(SetTime, "model exchange", double time)
NO_MODE(SetContinuousStates, "model exchange", const double *states, size_t size)
NO_MODE(GetContinuousStates, "model exchange", double *states, size_t size)
NO_MODE(GetContinuousStateDerivatives, "model exchange", double *rates, size_t size)
NO_MODE(GetNominalsOfContinuousStates, "model exchange", double *nominals, size_t size)
NO_MODE(GetEventIndicators, "model exchange", double *indicators, size_t size)
NO_MODE(GetNumberOfEventIndicators, "model exchange", size_t *count)
NO_MODE(GetNumberOfContinuousStates, "model exchange", size_t *count)
NO_MODE(EnterConfigurationMode, "structural parameters")
NO_MODE(ExitConfigurationMode, "structural parameters")
NO_MODE(GetNumberOfVariableDependencies, "dependencies of elements", uint32_t reference, size_t *count)
NO_MODE(GetVariableDependencies, "dependencies of elements", uint32_t reference, size_t *elements, uint32_t *others,
        size_t *elements_of_others, int *kinds, size_t count)
NO_MODE(GetAdjointDerivative, "adjoint derivatives", const uint32_t *unknowns, size_t outputs, const uint32_t *knowns,
        size_t inputs, const double *seed, size_t seeds, double *found, size_t size)

STATE_FUNCTIONS(FMUState, Deserialize)

FUNCTION(GetDirectionalDerivative, const uint32_t *unknowns, size_t outputs, const uint32_t *knowns, size_t inputs,
         const double *seed, size_t seeds, double *found, size_t size) {
    return each ? get_derivatives(each, unknowns, outputs, knowns, inputs, seed, seeds, found, size) : ERROR;
}

FUNCTION(DoStep, double t, double h, bool is_final, bool *has_event, bool *is_over, bool *returned_early,
         double *last_time) {
    (void)is_final;
    if (!each) return ERROR;
    int status = advance(each, t, h);
    *has_event = *is_over = *returned_early = false;
    *last_time = time_of(each);
    return status;
}
