/* FMI co-simulation of $title. The functions of FMI $fmi are in $source, which includes this file. */
#include "$name.c"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

/* Value references: a number for each input, output, and parameter. An array has that of its first number. */
enum {
    OUTPUTS = CONTROLS,           /* the first number that is an output, of `places` */
    PLACES = $places,
    POSITION_ERROR = OUTPUTS + PLACES, RESULT, SETTLED, INDEPENDENT, REFERENCES
};
/* size of the variable that begins with each number; 0: none does */
static const int sizes[REFERENCES] = {$sizes};
/* rod, node and number of y of each output */
static const int places[PLACES][3] = {$place_table};
static const char *const input_names[CONTROLS + 1] = {$input_names "time"};
static const char *const input_units[CONTROLS + 1] = {$input_units "s"};

/* status of both versions */
enum { OK, WARNING, DISCARD, ERROR };
enum { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED };

/* State of an instance, and its serialized form. */
typedef struct {
    uint64_t version;
    int64_t phase, settled;
    /* internal steps of the last communication step; 0: an equilibrium at the start; -1: none of both */
    int64_t steps;
    double start_time, inputs[CONTROLS + 1];
    /* the last communication step: the inputs held in it, and the robot before it */
    double held[CONTROLS + 1], before[${NAME}_SAVED];
} fmu_state;
typedef struct {
    fmu_state now;
    double robot[${NAME}_SAVED];
} saved_state;

typedef struct {
    /* robot_before and prediction: for derivatives */
    ${name}_robot robot, robot_before;
    ${name}_prediction prediction;
    fmu_state now;
    double backup[${NAME}_SAVED], controls[${NAME}_HORIZON * (CONTROLS + 1)];
    double tangents[${NAME}_HORIZON * 3 * (CONTROLS + 1)];
    int is_initial, has_tangents;
    log_function logger;
    void *environment;
    char name[256];
} instance;

/* Pass a message on to the importer. */
static void tell(const instance *each, const char *message);

static int report(instance *each, const char *format, ...) {
    char message[512];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(message, sizeof message, format, arguments);
    va_end(arguments);
    tell(each, message);
    return ERROR;
}

static double time_of(const instance *each) {
    return each->now.start_time + ${name}_time(&each->robot);
}

static void restart(instance *each) {
    memset(&each->now, 0, sizeof each->now);
    each->now.version = ${NAME}_VERSION;
    each->now.steps = -1;
    for (int c = 0; c < CONTROLS; c++) each->now.inputs[c] = fmin(fmax(0.0, ${name}_low[c]), ${name}_high[c]);
    each->is_initial = each->has_tangents = 0;
    ${name}_start(&each->robot);
}

/* Return a new instance; NULL: no memory, or the model description is that of another FMU. */
static instance *instantiate(const char *name, const char *token, log_function logger, void *environment) {
    instance *each = aligned_alloc(64, (sizeof *each + 63) / 64 * 64);
    if (!each) return NULL;
    memset(each, 0, sizeof *each);
    if (name) strncpy(each->name, name, sizeof each->name - 1);
    each->logger = logger;
    each->environment = environment;
    restart(each);
    if (token && strcmp(token, "$token") == 0) return each;
    report(each, "the model description is that of another FMU: its token is not $token");
    free(each);
    return NULL;
}

static int set_start_time(instance *each, double start_time) {
    if (each->now.phase != INSTANTIATED) return report(each, "the instance was initialized before: reset it first");
    if (!(fabs(start_time) <= DBL_MAX)) return report(each, "the start time is not finite");
    each->now.start_time = start_time;
    return OK;
}

static int initialize(instance *each) {
    if (each->now.phase != INSTANTIATED) return report(each, "the instance was initialized before: reset it first");
    each->now.phase = INITIALIZING;
    return OK;
}

/* false, and a message, if an input is not finite or beyond its limits */
static int has_inputs(instance *each) {
    for (int c = 0; c < CONTROLS; c++) {
        double input = each->now.inputs[c], least = ${name}_low[c], most = ${name}_high[c];
        if (input >= least && input <= most) continue;
        double limit = input < least ? least : input > most ? most : NAN;
        const char *name = input_names[c], *unit = input_units[c];
        if (fabs(limit) < DBL_MAX)
            report(each, "t = %g s: the input %s is %g %s; allowed is %s %g", time_of(each), name, input, unit,
                   limit == least ? "at least" : "at most", limit);
        else
            report(each, "t = %g s: the input %s is %g %s; allowed are finite numbers", time_of(each), name, input, unit);
        return 0;
    }
    return 1;
}

/* Bring the robot to its start, before values are read: in equilibrium without controls, or under the inputs. */
static int find_start(instance *each) {
    if (each->now.phase > INITIALIZING || each->is_initial) return OK;
    ${name}_start(&each->robot);
    each->now.steps = -1;
    each->has_tangents = 0;
    if (each->now.settled) {
        if (!has_inputs(each)) return ERROR;
        ${name}_save(&each->robot, each->now.before);
        int result = ${name}_equilibrium(&each->robot, each->now.inputs);
        if (result < 0) return report(each, "the equilibrium under the inputs: %s", ${name}_text(result));
        memcpy(each->now.held, each->now.inputs, sizeof each->now.held);
        each->now.steps = 0;
    }
    each->is_initial = 1;
    return OK;
}

static int finish_initialization(instance *each) {
    if (each->now.phase != INITIALIZING) return report(each, "the instance is not in initialization mode");
    int status = find_start(each);
    if (status == OK) each->now.phase = STEPPING;
    return status;
}

/* Make a communication step from t to t + h. If it fails, all is as it was before. */
static int advance(instance *each, double t, double h) {
    double now = time_of(each), count = floor(h / ${NAME}_DT + 0.5);
    if (each->now.phase != STEPPING) return report(each, "a step needs an instance that is initialized and not terminated");
    if (!(fabs(t - now) <= 0.5 * ${NAME}_DT))
        return report(each, "the communication point is t = %.12g s, but the robot is at t = %.12g s", t, now);
    if (!(count >= 1.0 && count <= 1e9 && fabs(h / ${NAME}_DT - count) <= 1e-6))
        return report(each, "t = %g s: the communication step is %.12g s; allowed are %.12g s and whole multiples", now, h,
                      ${NAME}_DT);
    if (!has_inputs(each)) return ERROR;
    ${name}_save(&each->robot, each->backup);
    for (int64_t k = 0; k < (int64_t)count; k++) {
        int result = ${name}_step(&each->robot, each->now.inputs, ${NAME}_DT);
        if (result >= 0) continue;
        now = time_of(each);
        if (k > 0) ${name}_load(&each->robot, each->backup);
        return report(each, "t = %g s: %s", now, ${name}_text(result));
    }
    memcpy(each->now.before, each->backup, sizeof each->backup);
    memcpy(each->now.held, each->now.inputs, sizeof each->now.held);
    each->now.steps = (int64_t)count;
    each->has_tangents = 0;
    return OK;
}

/* Return the size of a real variable; 0: the reference is of none. */
static int size_of(uint32_t reference) {
    return reference < RESULT || reference == INDEPENDENT ? sizes[reference] : 0;
}

static double value_of(const instance *each, int number) {
    if (number < OUTPUTS) return each->now.inputs[number];
    if (number == INDEPENDENT) return time_of(each);
    /* not known before the first step */
    if (number == POSITION_ERROR) return each->robot.position_error >= 0.0 ? each->robot.position_error : -1.0;
    const int *place = places[number - OUTPUTS];
    return y_of(&each->robot, place[0], place[1], place[2]);
}

static int get_numbers(instance *each, const uint32_t *references, size_t count, double *values, size_t size) {
    size_t at = 0;
    if (find_start(each) != OK) return ERROR;
    for (size_t k = 0; k < count; k++) {
        int own = size_of(references[k]);
        if (own == 0) return report(each, "no real variable has the value reference %u", (unsigned)references[k]);
        if (at + own > size) return report(each, "the variables have more than %zu numbers", size);
        for (int i = 0; i < own; i++) values[at++] = value_of(each, (int)references[k] + i);
    }
    return at == size ? OK : report(each, "the variables have %zu numbers, not %zu", at, size);
}

static int set_numbers(instance *each, const uint32_t *references, size_t count, const double *values, size_t size) {
    if (size != count) return report(each, "the inputs have %zu numbers, not %zu", count, size);
    for (size_t k = 0; k < count; k++) {
        if (references[k] >= CONTROLS) return report(each, "the value reference %u is of no input", (unsigned)references[k]);
        each->now.inputs[references[k]] = values[k];
    }
    each->is_initial = 0;
    return OK;
}

static int get_result(instance *each, const uint32_t *references, size_t count, int32_t *values, size_t size) {
    if (find_start(each) != OK) return ERROR;
    for (size_t k = 0; k < count; k++) {
        if (references[k] != RESULT || k >= size)
            return report(each, "no integer variable has the value reference %u", (unsigned)references[k]);
        values[k] = (int32_t)each->robot.result;
    }
    return OK;
}

/* Return the status for a reference to a Boolean variable. */
static int is_settled(instance *each, uint32_t reference) {
    return reference == SETTLED ? OK : report(each, "no Boolean variable has the value reference %u", (unsigned)reference);
}

static int set_settled(instance *each, uint32_t reference, int value) {
    if (is_settled(each, reference) != OK) return ERROR;
    if (each->now.phase > INITIALIZING) return report(each, "settled can be set before and during initialization only");
    each->now.settled = value != 0;
    each->is_initial = 0;
    return OK;
}

/* Find the derivatives of the robot at the end of the last communication step by the inputs held in it. */
static int find_tangents(instance *each) {
    if (find_start(each) != OK) return ERROR;
    if (each->now.steps < 0 || each->has_tangents) return OK;
    if (each->now.steps > ${NAME}_HORIZON)
        return report(each, "derivatives are known for communication steps of up to %d internal steps", ${NAME}_HORIZON);
    for (int k = 0; k < (int)each->now.steps || k == 0; k++)
        for (int c = 0; c < CONTROLS; c++) each->controls[k * CONTROLS + c] = each->now.held[c];
    ${name}_start(&each->robot_before);
    int result = ${name}_load(&each->robot_before, each->now.before);
    if (result >= 0)
        result = ${name}_predict(&each->robot_before, &each->prediction, (int)each->now.steps, each->controls, NULL,
                                 each->tangents);
    if (result < 0) return report(each, "derivatives: %s", ${name}_text(result));
    each->has_tangents = 1;
    return OK;
}

static double tangent_of(const instance *each, int number, int input) {
    const prediction_numbers *n = (const prediction_numbers *)(const void *)each->prediction.numbers;
    const int *place = places[number - OUTPUTS];
    int solutions = each->now.steps ? (int)each->now.steps * STAGES : 1;
    int row = ((solutions - 1) * NODES + place[1]) * NUMBERS + order[place[0] * OWN + place[2]];
    return each->now.steps < 0 ? 0.0 : n->d_rows[row * COLUMNS + input];
}

static int get_derivatives(instance *each, const uint32_t *unknowns, size_t count, const uint32_t *knowns,
                           size_t inputs, const double *seed, size_t seeds, double *found, size_t size) {
    size_t at = 0;
    if (find_tangents(each) != OK) return ERROR;
    if (seeds != inputs) return report(each, "there are %zu inputs, but %zu numbers of their changes", inputs, seeds);
    for (size_t j = 0; j < inputs; j++)
        if (knowns[j] >= CONTROLS)
            return report(each, "derivatives by the value reference %u: it is of no input", (unsigned)knowns[j]);
    for (size_t k = 0; k < count; k++) {
        int own = unknowns[k] >= OUTPUTS && unknowns[k] < POSITION_ERROR ? sizes[unknowns[k]] : 0;
        if (own == 0)
            return report(each, "derivatives of the value reference %u are not known", (unsigned)unknowns[k]);
        if (at + own > size) return report(each, "the outputs have more than %zu numbers", size);
        for (int i = 0; i < own; i++, at++) {
            found[at] = 0.0;
            for (size_t j = 0; j < inputs; j++)
                found[at] += tangent_of(each, (int)unknowns[k] + i, (int)knowns[j]) * seed[j];
        }
    }
    return at == size ? OK : report(each, "the outputs have %zu numbers, not %zu", at, size);
}

/* Save the state; `state` is allocated if it is NULL. */
static int get_state(instance *each, void **state) {
    if (find_start(each) != OK) return ERROR;
    if (!state || (!*state && !(*state = malloc(sizeof(saved_state))))) return report(each, "there is no memory for a state");
    saved_state *saved = *state;
    saved->now = each->now;
    ${name}_save(&each->robot, saved->robot);
    return OK;
}

static int set_state(instance *each, const void *state) {
    const saved_state *saved = state;
    if (!saved || saved->now.version != ${NAME}_VERSION || saved->now.phase < INSTANTIATED || saved->now.phase > TERMINATED
        || saved->now.steps < -1 || !(fabs(saved->now.start_time) <= DBL_MAX)
        || ${name}_load(&each->robot, saved->robot) < 0)
        return report(each, "the state is not one of this FMU, or is damaged");
    each->now = saved->now;
    each->has_tangents = 0;
    each->is_initial = 1;
    return OK;
}

static int free_state(void **state) {
    if (state) {
        free(*state);
        *state = NULL;
    }
    return OK;
}

static int serialize(instance *each, const void *state, uint8_t *bytes, size_t size) {
    if (!state || !bytes || size < sizeof(saved_state)) return report(each, "a state has %zu bytes", sizeof(saved_state));
    memcpy(bytes, state, sizeof(saved_state));
    return OK;
}

static int deserialize(instance *each, const uint8_t *bytes, size_t size, void **state) {
    uint64_t version = 0;
    if (bytes && size == sizeof(saved_state)) memcpy(&version, bytes, sizeof version);
    if (version != ${NAME}_VERSION || !state) return report(each, "the bytes are not a state of this FMU");
    if (!*state && !(*state = malloc(sizeof(saved_state)))) return report(each, "there is no memory for a state");
    memcpy(*state, bytes, sizeof(saved_state));
    return OK;
}

static int terminate(instance *each) {
    each->now.phase = TERMINATED;
    return OK;
}

/* A function that this FMU has no use for. */
static int refuse(instance *each, const char *what) {
    return report(each, "%s: this FMU has none", what);
}

#define EXPORTED __attribute__((visibility("default")))

/* functions of states, of which the standards spell the names in their own way */
#define STATE_FUNCTIONS(state, read)                                                             \
    FUNCTION(Get##state, void **found) { return each ? get_state(each, found) : ERROR; }         \
    FUNCTION(Set##state, void *given) { return each ? set_state(each, given) : ERROR; }          \
    FUNCTION(Free##state, void **given) { return each ? free_state(given) : ERROR; }             \
    FUNCTION(Serialized##state##Size, void *given, size_t *size) {                               \
        (void)given;                                                                             \
        *size = sizeof(saved_state);                                                             \
        return each ? OK : ERROR;                                                                \
    }                                                                                            \
    FUNCTION(Serialize##state, void *given, uint8_t *bytes, size_t size) {                       \
        return each ? serialize(each, given, bytes, size) : ERROR;                               \
    }                                                                                            \
    FUNCTION(read##state, const uint8_t *bytes, size_t size, void **found) {                     \
        return each ? deserialize(each, bytes, size, found) : ERROR;                             \
    }
