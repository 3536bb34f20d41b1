/* $title: the functions of $name.h, around the engine's code in $name.o. */
#include "$name.h"

#include <float.h>
#include <math.h>
#include <string.h>

/* the engine's functions and tables, in $name.o */
void ${name}_run(double *memory, double *motion, const double *parameters, const double *controls,
                 const double *coefficients, const double *extrapolations, double *results, int64_t size,
                 int64_t vectors, int64_t steps, int64_t stages, int64_t estimates, int64_t kept);
void ${name}_settle(double *memory, double *motion);
void ${name}_run_tangents(double *memory, const double *controls, const double *coefficients,
                          const double *rows, const double *unknowns, const double *directions,
                          double *states, const double *weights, const double *d_controls, double *d_rows,
                          double *d_unknowns, int64_t steps, int64_t directions_count, int64_t columns);
extern const int64_t ${name}_image_at[], ${name}_image[], ${name}_tangent_image_at[], ${name}_tangent_image[];
extern const double ${name}_motion[], ${name}_table[], ${name}_guesses[];

enum {
    CONTROLS = ${NAME}_CONTROLS, RODS = ${NAME}_RODS, NODES = ${NAME}_NODES,
    STAGES = $stages,             /* solutions in a step */
    ROWS = $table_rows,           /* coefficients of the first steps and of all later ones */
    WIDTH = $table_width,         /* numbers of the coefficients of a solution */
    NUMBERS = $numbers,           /* numbers of a node, of all rods */
    OWN = NUMBERS / RODS,
    UNKNOWNS = $unknowns,
    INFO = 8 + UNKNOWNS,          /* numbers of a solution's outcome */
    MOTION = $motion, SHAPE = $shape,
    IMAGE = $image, TANGENT_IMAGE = $tangent_image,
    PARAMETERS = $parameters,
    ESTIMATES = $estimates,
    Y = $y_at, Y_APART = $y_apart,      /* y in a motion, and the distance between its numbers */
    Z = $record_at, Z_APART = $record_apart, Y_SIZE = $y_size,
    RECORDS = $records, RECORD_ROWS = $record_rows, RECORD_USED = $used,
    HISTORY = $history_at, HISTORY_SIZE = $history_size, /* history terms in memory: an equilibrium has none */
    TIME = $time_at,                    /* time of row 0 in a motion */
    LENGTH = $length_at,                /* the length in the parameters; -1: none */
    POSITION = $position, ORIENTATION = $orientation, STRETCH = $stretch,
    FORCE = $force, MOMENT = $moment,   /* numbers of y; -1: none */
    COLUMNS = $columns,                 /* of tangents, in whole vectors */
    TANGENT_STATES = $tangent_states, TANGENT_PARAMETERS_AT = $tangent_parameters_at
};
static const double ends[STAGES] = {$ends};
const double ${name}_low[CONTROLS + 1] = {$low}, ${name}_high[CONTROLS + 1] = {$high};
static const int moves[CONTROLS + 1] = {$moves};
/* the control that is each axis of an end that turns; -1: none */
static const int turning[$turns + 1][3] = {$turning};
static const int points[RODS * NODES] = {$points};
static const int order[NUMBERS] = {$order};
static const int64_t record_at[RECORDS] = {$records_at}, tangent_record_at[RECORDS] = {$tangent_records_at};
static const int64_t record_apart[RECORDS] = {$records_apart}, tangent_record_apart[RECORDS] = {$tangent_records_apart};
static const double length = $length;
/* range from which the model was learned, with its tolerance */
static const double least_control[CONTROLS + 1] = {$controls_low}, most_control[CONTROLS + 1] = {$controls_high};
static const double least_strain[RODS * $strains + 1] = {$strains_low}, most_strain[RODS * $strains + 1] = {$strains_high};

/* numbers of a prediction, one part after the other */
enum { MOST = ${NAME}_HORIZON * STAGES };
typedef struct {
    double controls[MOST * (CONTROLS + 1)], table[MOST * WIDTH], rows[MOST * NODES * NUMBERS];
    double unknowns[MOST * (UNKNOWNS + 1)], d_controls[MOST * (CONTROLS + 1) * COLUMNS];
    double d_rows[MOST * NODES * NUMBERS * COLUMNS], d_unknowns[MOST * (UNKNOWNS + 1) * COLUMNS];
} prediction_numbers;
typedef char numbers_fit[sizeof(prediction_numbers) <= sizeof(((${name}_prediction *)0)->numbers) ? 1 : -1];

static void unpack(double *memory, size_t size, const int64_t *at, const int64_t *image, int count) {
    for (size_t k = 0; k < size; k++) memory[k] = 0.0;
    for (int k = 0; k < count; k++) memcpy(memory + at[k], image + k, sizeof *image);
}

static int is_started(const ${name}_robot *robot) {
    return robot && robot->version == ${NAME}_VERSION;
}

/* false for NaN, too */
static int are_allowed(const double *control) {
    int allowed = control != NULL || CONTROLS == 0;
    for (int k = 0; allowed && k < CONTROLS; k++) allowed = control[k] >= ${name}_low[k] && control[k] <= ${name}_high[k];
    return allowed;
}

static int turns_far(const double *before, const double *control) {
    for (int k = 0; k < $turns; k++) {
        double square = 0.0;
        for (int i = 0; i < 3; i++) {
            double change = turning[k][i] < 0 ? 0.0 : control[turning[k][i]] - before[turning[k][i]];
            square += change * change;
        }
        if (square > $largest_turn * $largest_turn) return 1;
    }
    return 0;
}

size_t ${name}_robot_size(void) { return sizeof(${name}_robot); }

size_t ${name}_prediction_size(void) { return sizeof(${name}_prediction); }

void ${name}_start(${name}_robot *robot) {
    memset(robot, 0, offsetof(${name}_robot, results));
    robot->version = ${NAME}_VERSION;
    robot->parameters = ${name}_parameters;
    robot->result = $start_result;
    robot->position_error = robot->time_error = NAN;
    memcpy(robot->motion, ${name}_motion, sizeof robot->motion);
    unpack(robot->memory, sizeof robot->memory / sizeof(double), ${name}_image_at, ${name}_image, IMAGE);
}

/* Return the result of the last solution in `results`. */
static int result_of(${name}_robot *robot, int stages) {
    double *info = robot->results + stages * NODES * NUMBERS, *end = info + stages * INFO;
    double residual = 0.0;
    if (!(end[0] >= 1.0)) return ${NAME}_NO_CONVERGENCE;
    for (int k = 0; k < stages; k++) {
        double own = info[k * INFO + 1];
        /* a number that is not finite is kept */
        residual = own <= residual ? residual : own;
    }
    info += (stages - 1) * INFO;
    if (!(residual <= $acceptable)) return ${NAME}_NO_CONVERGENCE;
    robot->residual = residual;
    robot->position_error = info[4];
    robot->time_error = stages == STAGES && $has_time_error && info[6] <= length ? info[6] : NAN;
    if ($unseen) {
        robot->position_error = NAN;
        return ${NAME}_COARSE;
    }
    int fine = !$judges || (info[4] <= $coarse_share * end[1] && info[5] <= $coarse_angle);
    return fine ? ${NAME}_CONVERGED : ${NAME}_COARSE;
}

int ${name}_step(${name}_robot *robot, const double *control, double dt) {
    double acting[STAGES * (CONTROLS + 1)] = {0.0}, table[STAGES * WIDTH];
    if (!is_started(robot)) return ${NAME}_BAD_STATE;
    if (!are_allowed(control)) return ${NAME}_BAD_CONTROL;
    if (!(fabs(dt - ${NAME}_DT) <= 1e-9 * ${NAME}_DT)) return ${NAME}_BAD_STEP;
    if (turns_far(robot->control, control)) return ${NAME}_FAR_TURN;
    const double *row = ${name}_table + (robot->steps < ROWS ? robot->steps : ROWS - 1) * STAGES * WIDTH;
    for (int k = 0; k < STAGES; k++) {
        for (int c = 0; c < CONTROLS; c++) {
            double before = robot->control[c];
            acting[k * CONTROLS + c] = moves[c] ? before + ends[k] * (control[c] - before) : control[c];
        }
        memcpy(table + k * WIDTH, row + k * WIDTH, WIDTH * sizeof *table);
        table[k * WIDTH + WIDTH - 1] = ((double)robot->steps + ends[k]) * ${NAME}_DT;
    }
    for (size_t k = 0; k < sizeof robot->results / sizeof(double); k++) robot->results[k] = 0.0;
    double residual = robot->residual, position_error = robot->position_error, time_error = robot->time_error;
    ${name}_run(robot->memory, robot->motion, robot->parameters, acting, table, ${name}_guesses, robot->results,
                MOTION, 1, 1, STAGES, ESTIMATES, robot->continues);
    int result = result_of(robot, STAGES);
    robot->continues = result >= 0;
    if (result < 0) {
        robot->residual = residual;
        robot->position_error = position_error;
        robot->time_error = time_error;
        return result;
    }
    /* on a coarse grid, the motion may have left the exact one */
    robot->result = result > robot->result ? result : robot->result;
    for (int c = 0; c < CONTROLS; c++) robot->control[c] = control[c];
    robot->steps++;
    robot->acts = 1;
    return (int)robot->result;
}

/* Solve the equilibrium under a control from y; y is replaced if it is found. */
static int solve_shape(${name}_robot *robot, const double *control, double *shape) {
    double table[WIDTH] = {0.0};
    table[WIDTH - 1] = ${name}_time(robot);
    double t0 = robot->memory[$memory_time_at];
    robot->memory[$memory_time_at] = 0.0;
    for (int k = 0; k < HISTORY_SIZE; k++) robot->memory[HISTORY + k] = 0.0;
    for (size_t k = 0; k < sizeof robot->results / sizeof(double); k++) robot->results[k] = 0.0;
    ${name}_run(robot->memory, shape, robot->parameters, control, table, ${name}_guesses, robot->results, SHAPE, 1, 1,
                1, ESTIMATES > 1 ? 1 : ESTIMATES, 0);
    robot->memory[$memory_time_at] = t0;
    robot->continues = 0;
    return result_of(robot, 1);
}

int ${name}_equilibrium(${name}_robot *robot, const double *control) {
    double shape[SHAPE], begun[CONTROLS + 1], next[CONTROLS + 1], part = 1.0, done = 0.0;
    if (!is_started(robot)) return ${NAME}_BAD_STATE;
    if (!are_allowed(control)) return ${NAME}_BAD_CONTROL;
    double residual = robot->residual, position_error = robot->position_error, time_error = robot->time_error;
    memcpy(shape, robot->motion + Y, sizeof shape);
    memcpy(begun, robot->control, sizeof begun);
    int result = ${NAME}_NO_CONVERGENCE;
    while (done < 1.0) {
        double reached = done + part < 1.0 ? done + part : 1.0;
        for (int c = 0; c < CONTROLS; c++)
            next[c] = reached == 1.0 ? control[c] : begun[c] + reached * (control[c] - begun[c]);
        double last[CONTROLS + 1];
        for (int c = 0; c < CONTROLS; c++) last[c] = begun[c] + done * (control[c] - begun[c]);
        result = turns_far(last, next) ? ${NAME}_NO_CONVERGENCE : solve_shape(robot, next, shape);
        if (result >= 0) {
            done = reached;
            part = 2.0 * part;
        } else if ((part = 0.5 * part) < 1.0 / 1024.0) {
            robot->residual = residual;
            robot->position_error = position_error;
            robot->time_error = time_error;
            return result;
        }
    }
    double now = ${name}_time(robot);
    ${name}_settle(robot->memory, robot->motion);
    robot->start_time = robot->motion[TIME] = now;
    robot->steps = 0;
    robot->acts = 1;
    robot->result = result > $start_result ? result : $start_result;
    for (int c = 0; c < CONTROLS; c++) robot->control[c] = control[c];
    return (int)robot->result;
}

double ${name}_time(const ${name}_robot *robot) {
    return robot->start_time + (double)robot->steps * ${NAME}_DT;
}

/* Number i of y at a node. */
static double y_of(const ${name}_robot *robot, int rod, int node, int i) {
    return robot->motion[Y + i * Y_APART + points[rod * NODES + node]];
}

/* Direction in which the rod runs from a node, and its stretch: R v. */
static void along(const ${name}_robot *robot, int rod, int node, double tangent[3]) {
    double h[4], v[3] = {0.0, 0.0, 1.0};
    for (int i = 0; i < 4; i++) h[i] = y_of(robot, rod, node, ORIENTATION + i);
    for (int i = 0; i < 3 && STRETCH >= 0; i++)
        v[i] = robot->motion[Z + (STRETCH + i) * Z_APART + points[rod * NODES + node]];
    double square = h[0] * h[0] + h[1] * h[1] + h[2] * h[2] + h[3] * h[3];
    double t[3] = {
        h[2] * v[2] - h[3] * v[1] + h[0] * v[0],
        h[3] * v[0] - h[1] * v[2] + h[0] * v[1],
        h[1] * v[1] - h[2] * v[0] + h[0] * v[2],
    };
    /* v + 2 q x (q x v + w v), for a quaternion of any size */
    tangent[0] = v[0] + 2.0 / square * (h[2] * t[2] - h[3] * t[1]);
    tangent[1] = v[1] + 2.0 / square * (h[3] * t[0] - h[1] * t[2]);
    tangent[2] = v[2] + 2.0 / square * (h[1] * t[1] - h[2] * t[0]);
}

int ${name}_pose(const ${name}_robot *robot, int rod, int node, double *position, double *orientation) {
    if (!is_started(robot)) return ${NAME}_BAD_STATE;
    if (rod < 0 || rod >= RODS || node < 0 || node >= NODES) return ${NAME}_BAD_ARGUMENT;
    if (orientation && ORIENTATION < 0) return ${NAME}_BAD_ARGUMENT;
    for (int i = 0; position && i < 3; i++) position[i] = y_of(robot, rod, node, POSITION + i);
    for (int i = 0; orientation && i < 4; i++) orientation[i] = y_of(robot, rod, node, ORIENTATION + i);
    return (int)robot->result;
}

int ${name}_pose_at(const ${name}_robot *robot, int rod, double place, double *position, double *orientation) {
    if (!is_started(robot)) return ${NAME}_BAD_STATE;
    if (rod < 0 || rod >= RODS || !(place >= 0.0 && place <= 1.0)) return ${NAME}_BAD_ARGUMENT;
    if (orientation && ORIENTATION < 0) return ${NAME}_BAD_ARGUMENT;
    double at = place * (NODES - 1);
    int node = at >= NODES - 2 ? NODES - 2 : (int)at;
    double part = at - node, left[3], right[3];
    if (ORIENTATION >= 0) {
        along(robot, rod, node, left);
        along(robot, rod, node + 1, right);
    }
    for (int i = 0; position && i < 3; i++) {
        double p = y_of(robot, rod, node, POSITION + i), chord = y_of(robot, rod, node + 1, POSITION + i) - p;
        double bend = 0.0, step = (LENGTH < 0 ? length : robot->parameters[LENGTH]) / (NODES - 1);
        if (ORIENTATION >= 0) bend = (1.0 - part) * (step * left[i] - chord) - part * (step * right[i] - chord);
        position[i] = p + part * chord + part * (1.0 - part) * bend;
    }
    if (orientation) {
        double h[4], same = 0.0, square = 0.0;
        for (int i = 0; i < 4; i++)
            same += y_of(robot, rod, node, ORIENTATION + i) * y_of(robot, rod, node + 1, ORIENTATION + i);
        for (int i = 0; i < 4; i++) {
            double next = y_of(robot, rod, node + 1, ORIENTATION + i);
            h[i] = (1.0 - part) * y_of(robot, rod, node, ORIENTATION + i) + part * (same >= 0.0 ? next : -next);
            square += h[i] * h[i];
        }
        for (int i = 0; i < 4; i++) orientation[i] = h[i] / sqrt(square);
    }
    return (int)robot->result;
}

int ${name}_tip(const ${name}_robot *robot, double *position) {
    return ${name}_pose(robot, $tip_rod, NODES - 1, position, NULL);
}

int ${name}_base_wrench(const ${name}_robot *robot, int rod, double *force, double *moment) {
    if (!is_started(robot)) return ${NAME}_BAD_STATE;
    if (rod < 0 || rod >= RODS || FORCE < 0 || MOMENT < 0) return ${NAME}_BAD_ARGUMENT;
    for (int i = 0; i < 3; i++) {
        if (force) force[i] = y_of(robot, rod, 0, FORCE + i);
        if (moment) moment[i] = y_of(robot, rod, 0, MOMENT + i);
    }
    return (int)robot->result;
}

int ${name}_extrapolates(const ${name}_robot *robot) {
    if (!is_started(robot)) return 0;
    /* before the first step no control acts */
    for (int k = 0; k < CONTROLS && robot->acts; k++)
        if (robot->control[k] < least_control[k] || robot->control[k] > most_control[k]) return 1;
    for (int rod = 0; rod < RODS; rod++)
        for (int i = 0; i < $strains; i++)
            for (int node = 0; node < NODES; node++) {
                double z = robot->motion[Z + (Y_SIZE + i) * Z_APART + points[rod * NODES + node]];
                int k = rod * $strains + i;
                if (z < least_strain[k] || z > most_strain[k]) return 1;
            }
    return 0;
}

/* Prepare the memory of tangents at the robot's state. */
static void begin_tangents(const ${name}_robot *robot, ${name}_prediction *memory) {
    unpack(memory->memory, sizeof memory->memory / sizeof(double), ${name}_tangent_image_at, ${name}_tangent_image,
           TANGENT_IMAGE);
    memcpy(memory->memory + TANGENT_PARAMETERS_AT, robot->parameters, PARAMETERS * sizeof(double));
    for (int k = 0; k < RECORDS; k++)
        for (int i = 0; i < RECORD_ROWS; i++)
            memcpy(memory->memory + tangent_record_at[k] + i * tangent_record_apart[k],
                   robot->motion + record_at[k] + i * record_apart[k], RECORD_USED * sizeof(double));
    for (size_t k = 0; k < sizeof memory->states / sizeof(double); k++) memory->states[k] = 0.0;
}

/* Keep the solutions of a step for the tangents. */
static void keep_solutions(prediction_numbers *n, const double *results, int first, int stages) {
    const double *info = results + stages * NODES * NUMBERS;
    for (int k = 0; k < stages; k++) {
        for (int node = 0; node < NODES; node++)
            for (int i = 0; i < NUMBERS; i++)
                n->rows[((first + k) * NODES + node) * NUMBERS + order[i]] = results[(k * NODES + node) * NUMBERS + i];
        for (int i = 0; i < UNKNOWNS; i++) n->unknowns[(first + k) * UNKNOWNS + i] = info[k * INFO + 8 + i];
    }
}

int ${name}_predict(const ${name}_robot *robot, ${name}_prediction *memory, int steps, const double *controls,
                    double *tips, double *tangents) {
    if (!is_started(robot) || !memory) return ${NAME}_BAD_STATE;
    if (steps < 0 || steps > ${NAME}_HORIZON || (!controls && CONTROLS > 0)) return ${NAME}_BAD_ARGUMENT;
    prediction_numbers *n = (prediction_numbers *)(void *)memory->numbers;
    int stages = steps ? STAGES : 1, count = steps ? steps : 1, result = ${NAME}_CONVERGED;
    memory->robot = *robot;
    begin_tangents(robot, memory);
    for (int k = 0; k < count; k++) {
        const double *control = CONTROLS ? controls + k * CONTROLS : NULL;
        for (int j = 0; j < stages; j++) {
            int at = k * stages + j;
            double *row = n->table + at * WIDTH;
            for (int i = 0; i < WIDTH; i++) row[i] = 0.0;
            int64_t done = memory->robot.steps;
            if (steps) memcpy(row, ${name}_table + ((done < ROWS ? done : ROWS - 1) * STAGES + j) * WIDTH, WIDTH * sizeof *row);
            row[WIDTH - 1] = memory->robot.start_time + (steps ? ((double)done + ends[j]) * ${NAME}_DT : (double)done * ${NAME}_DT);
            for (int c = 0; c < CONTROLS; c++) {
                double before = memory->robot.control[c], end = steps ? ends[j] : 1.0;
                n->controls[at * CONTROLS + c] = moves[c] ? before + end * (control[c] - before) : control[c];
                for (int i = 0; i < COLUMNS; i++)
                    n->d_controls[(at * CONTROLS + c) * COLUMNS + i] = i != c ? 0.0 : moves[c] && k == 0 ? end : 1.0;
            }
        }
        result = steps ? ${name}_step(&memory->robot, control, ${NAME}_DT) : ${name}_equilibrium(&memory->robot, control);
        if (result < 0) return result;
        keep_solutions(n, memory->robot.results, k * stages, stages);
        if (tips) ${name}_tip(&memory->robot, tips + 3 * k);
    }
    if (!tangents) return result;
    ${name}_run_tangents(memory->memory, n->controls, n->table, n->rows, n->unknowns, NULL, memory->states, NULL,
                         n->d_controls, n->d_rows, n->d_unknowns, count * stages, 0, COLUMNS);
    for (int k = 0; k < count; k++)
        for (int i = 0; i < 3; i++) {
            int at = ((k * stages + stages - 1) * NODES + NODES - 1) * NUMBERS + order[$tip_rod * OWN + POSITION + i];
            for (int c = 0; c < CONTROLS; c++) tangents[(k * 3 + i) * CONTROLS + c] = n->d_rows[at * COLUMNS + c];
        }
    return result;
}

/* order of the numbers of a saved state: version (as bits), steps, result, time of the start, residual, errors,
 * whether controls act, controls, motion */
enum { OF_CONTROL = 8, OF_MOTION = OF_CONTROL + CONTROLS };

int ${name}_save(const ${name}_robot *robot, double *saved) {
    if (!is_started(robot)) return ${NAME}_BAD_STATE;
    if (!saved) return ${NAME}_BAD_ARGUMENT;
    memcpy(saved, &robot->version, sizeof robot->version);
    saved[1] = (double)robot->steps;
    saved[2] = (double)robot->result;
    saved[3] = robot->start_time;
    saved[4] = robot->residual;
    saved[5] = robot->position_error;
    saved[6] = robot->time_error;
    saved[7] = (double)robot->acts;
    memcpy(saved + OF_CONTROL, robot->control, CONTROLS * sizeof *saved);
    memcpy(saved + OF_MOTION, robot->motion, sizeof robot->motion);
    return (int)robot->result;
}

int ${name}_load(${name}_robot *robot, const double *saved) {
    uint64_t version;
    if (!is_started(robot) || !saved) return ${NAME}_BAD_STATE;
    memcpy(&version, saved, sizeof version);
    if (version != ${NAME}_VERSION) return ${NAME}_BAD_STATE;
    /* estimated errors may be unknown, NaN; the state may not */
    if (!(saved[1] >= 0.0 && saved[1] < 9e15) || !(saved[2] == 0.0 || saved[2] == 1.0)) return ${NAME}_BAD_STATE;
    if (!(saved[7] == 0.0 || saved[7] == 1.0)) return ${NAME}_BAD_STATE;
    if (!(fabs(saved[3]) <= DBL_MAX) || !are_allowed(saved + OF_CONTROL)) return ${NAME}_BAD_STATE;
    for (int k = 0; k < TIME; k++)
        if (!(fabs(saved[OF_MOTION + k]) <= DBL_MAX)) return ${NAME}_BAD_STATE;
    robot->steps = (int64_t)saved[1];
    robot->result = (int64_t)saved[2];
    robot->start_time = saved[3];
    robot->residual = saved[4];
    robot->position_error = saved[5];
    robot->time_error = saved[6];
    robot->continues = 0;
    robot->acts = (int64_t)saved[7];
    memcpy(robot->control, saved + OF_CONTROL, CONTROLS * sizeof *saved);
    memcpy(robot->motion, saved + OF_MOTION, sizeof robot->motion);
    robot->motion[TIME] = robot->start_time;
    return (int)robot->result;
}

const char *${name}_text(int result) {
    switch (result) {
    case ${NAME}_CONVERGED: return "solved";
    case ${NAME}_COARSE: return "solved, but the grid is too coarse: export the robot with more nodes";
    case ${NAME}_NO_CONVERGENCE: return "no solution found: change the controls in smaller parts";
    case ${NAME}_BAD_CONTROL: return "a control is not finite, or beyond its limits";
    case ${NAME}_BAD_STEP: return "the time step is not that of the exported model";
    case ${NAME}_BAD_STATE: return "the robot was not started, or the state is that of another model";
    case ${NAME}_FAR_TURN: return "an end turns by more than $largest_turn rad in one step";
    case ${NAME}_BAD_ARGUMENT: return "there is no such node, rod or number of steps";
    default: return "unknown result";
    }
}
