/* $title: FMI 2.0 for co-simulation, around fmu.c. */
typedef void (*log_function)(void *environment, const char *instance, int status, const char *category,
                             const char *message, ...);
#include "fmu.c"

/* types of FMI 2.0 */
typedef const char *string;
typedef struct {
    log_function logger;
    void *(*allocate)(size_t count, size_t size);
    void (*release)(void *memory);
    void (*step_finished)(void *environment, int status);
    void *environment;
} callbacks;
enum { CO_SIMULATION = 1, LAST_SUCCESSFUL_TIME = 2, IS_TERMINATED = 3 };

/* messages have no %: they are their own format, which importers can show that read no further arguments */
static void tell(const instance *each, const char *message) {
    if (each->logger) each->logger(each->environment, each->name, ERROR, "logStatusError", message);
}

/* A function of an instance. */
#define FUNCTION(name, ...) EXPORTED int fmi2##name(instance *each, ##__VA_ARGS__)
#define REFERENCES_OF(type) const uint32_t *references, size_t count, type *values

EXPORTED string fmi2GetTypesPlatform(void) { return "default"; }

EXPORTED string fmi2GetVersion(void) { return "2.0"; }

EXPORTED instance *fmi2Instantiate(string name, int type, string token, string resources, const callbacks *given,
                                   int visible, int logging) {
    (void)resources, (void)visible, (void)logging;
    if (type != CO_SIMULATION) return NULL;
    return instantiate(name, token, given ? given->logger : NULL, given ? given->environment : NULL);
}

EXPORTED void fmi2FreeInstance(instance *each) { free(each); }

/* errors are logged always, and nothing else is */
FUNCTION(SetDebugLogging, int logging, size_t count, const string *categories) {
    (void)logging, (void)count, (void)categories;
    return each ? OK : ERROR;
}

FUNCTION(SetupExperiment, int has_tolerance, double tolerance, double start_time, int has_stop, double stop_time) {
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop_time;
    return each ? set_start_time(each, start_time) : ERROR;
}

FUNCTION(EnterInitializationMode) { return each ? initialize(each) : ERROR; }

FUNCTION(ExitInitializationMode) { return each ? finish_initialization(each) : ERROR; }

FUNCTION(Terminate) { return each ? terminate(each) : ERROR; }

FUNCTION(Reset) {
    if (!each) return ERROR;
    restart(each);
    return OK;
}

FUNCTION(GetReal, REFERENCES_OF(double)) { return each ? get_numbers(each, references, count, values, count) : ERROR; }

FUNCTION(SetReal, REFERENCES_OF(const double)) {
    return each ? set_numbers(each, references, count, values, count) : ERROR;
}

FUNCTION(GetInteger, REFERENCES_OF(int)) { return each ? get_result(each, references, count, values, count) : ERROR; }

FUNCTION(GetBoolean, REFERENCES_OF(int)) {
    for (size_t k = 0; each && k < count; k++) {
        if (is_settled(each, references[k]) != OK) return ERROR;
        values[k] = each->now.settled != 0;
    }
    return each ? OK : ERROR;
}

FUNCTION(SetBoolean, REFERENCES_OF(const int)) {
    for (size_t k = 0; each && k < count; k++)
        if (set_settled(each, references[k], values[k]) != OK) return ERROR;
    return each ? OK : ERROR;
}

/* Functions of variables that this FMU does not have: allowed without variables only. */
#define UNUSED(name, what, ...)                                 \
    FUNCTION(name, const uint32_t *references, size_t count, ##__VA_ARGS__) { \
        (void)references;                                       \
        return !each ? ERROR : count == 0 ? OK : refuse(each, what); \
    }
UNUSED(SetInteger, "integer inputs", const int *values)
UNUSED(GetString, "strings", string *values)
UNUSED(SetString, "strings", const string *values)
UNUSED(SetRealInputDerivatives, "derivatives of inputs by time", const int *orders, const double *values)
UNUSED(GetRealOutputDerivatives, "derivatives of outputs by time", const int *orders, double *values)

STATE_FUNCTIONS(FMUstate, DeSerialize)

FUNCTION(GetDirectionalDerivative, const uint32_t *unknowns, size_t outputs, const uint32_t *knowns, size_t inputs,
         const double *seed, double *found) {
    return each ? get_derivatives(each, unknowns, outputs, knowns, inputs, seed, inputs, found, outputs) : ERROR;
}

FUNCTION(DoStep, double t, double h, int is_final) {
    (void)is_final;
    return each ? advance(each, t, h) : ERROR;
}

FUNCTION(CancelStep) { return each ? refuse(each, "steps in the background") : ERROR; }

/* every step has ended when fmi2DoStep returns */
FUNCTION(GetRealStatus, int kind, double *value) {
    if (!each || kind != LAST_SUCCESSFUL_TIME) return each ? DISCARD : ERROR;
    *value = time_of(each);
    return OK;
}

FUNCTION(GetBooleanStatus, int kind, int *value) {
    if (!each || kind != IS_TERMINATED) return each ? DISCARD : ERROR;
    *value = 0;
    return OK;
}

#define NO_STATUS(name, type)               \
    FUNCTION(name, int kind, type *value) { \
        (void)kind, (void)value;            \
        return each ? DISCARD : ERROR;      \
    }
NO_STATUS(GetStatus, int)
NO_STATUS(GetIntegerStatus, int)
NO_STATUS(GetStringStatus, string)
