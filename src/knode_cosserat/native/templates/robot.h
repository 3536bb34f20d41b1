/* $title
 *
 * Exported by KNODE-Cosserat $version on $date: $description.
 * Time step $dt s, scheme $scheme in time and $space along the rod, target $target.
 *
 * Units are SI: m, s, N, N m, Pa, rad. Positions and orientations are in the frame of the robot's file, in
 * which the base stands and the rod leaves it along z. Orientations are unit quaternions, scalar first.
 *
 * No function allocates memory, or calls anything beyond the mathematical functions of C (log, sin, cos, ...),
 * memcpy and memset.
 * All state is in one structure: as many robots as wanted may be used side by side, each by one thread at a
 * time. A structure is copied by assignment. It is aligned to 64 bytes: make it static, or with
 * aligned_alloc(64, sizeof *robot), or in C++17 with new.
 */
/* Passport.
$passport
 */
#ifndef ${NAME}_H
#define ${NAME}_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
#define ${NAME}_ALIGNED alignas(64)
extern "C" {
#else
#define ${NAME}_ALIGNED _Alignas(64)
#endif

/* This model: states of another one are refused. */
#define ${NAME}_VERSION UINT64_C($digest)
/* Time step (s). */
#define ${NAME}_DT $dt_exact
/* Rods, nodes along each, and controls. */
#define ${NAME}_RODS $rods
#define ${NAME}_NODES $nodes
#define ${NAME}_CONTROLS $controls
/* Most steps of one prediction. */
#define ${NAME}_HORIZON $horizon
/* Doubles of a saved state. */
#define ${NAME}_SAVED $saved

/* Results: zero and above, solved; below zero, the robot is as it was before the call. From a COARSE step on,
 * all steps are: the motion may have left the exact one. */
enum ${name}_result {
    ${NAME}_CONVERGED = 0,      /* solved to tolerance */
    ${NAME}_COARSE = 1,         /* solved, but the grid is too coarse: errors above 2 % of the length */
    ${NAME}_NO_CONVERGENCE = -1, /* no solution was found: smaller changes of the controls may help */
    ${NAME}_BAD_CONTROL = -10,  /* a control is not finite, or beyond its limits */
    ${NAME}_BAD_STEP = -11,     /* the time step is not ${NAME}_DT */
    ${NAME}_BAD_STATE = -12,    /* not started, or a state of another model, or numbers that are not finite */
    ${NAME}_FAR_TURN = -13,     /* an end turns by more than $largest_turn rad in one step */
    ${NAME}_BAD_ARGUMENT = -14  /* a node, rod or number of steps that does not exist */
};

/* Controls: name, unit, least and largest value.
$control_table
 */
extern const double ${name}_low[${NAME}_CONTROLS + 1], ${name}_high[${NAME}_CONTROLS + 1];

/* Parameters: a value that is zero in this file stays zero in the code. To change others, let
 * robot->parameters point to a copy of ${name}_parameters that you have changed, then call ${name}_equilibrium. A program
 * that loads this code as a shared library finds them at robot->parameters after the start.
$parameter_table
 */
extern const double ${name}_parameters[$parameters];

typedef struct ${name}_robot {
    uint64_t version;
    int64_t steps;
    int64_t result;
    int64_t continues;
    int64_t acts;
    const double *parameters;
    double start_time;
    /* of the last step: the control, the largest residual (natural units), and estimated errors of positions
     * (m) by the grid and by the time step; NaN: not known */
    double control[${NAME}_CONTROLS + 1];
    double residual, position_error, time_error;
    /* the remaining numbers are the engine's own */
    ${NAME}_ALIGNED double motion[$motion];
    ${NAME}_ALIGNED double results[$results];
    ${NAME}_ALIGNED double memory[$memory];
} ${name}_robot;

/* Memory of predictions. */
typedef struct ${name}_prediction {
    ${name}_robot robot;
    ${NAME}_ALIGNED double memory[$tangent_memory];
    ${NAME}_ALIGNED double states[$tangent_states];
    ${NAME}_ALIGNED double numbers[$tangent_numbers];
} ${name}_prediction;

/* Bytes of the two structures, for other languages than C; their address is a multiple of 64. */
size_t ${name}_robot_size(void);
size_t ${name}_prediction_size(void);

/* Start at time 0 where `simulate` starts: $start. */
void ${name}_start(${name}_robot *robot);

/* Make one time step of dt (s) under controls that are held during it. */
int ${name}_step(${name}_robot *robot, const double *control, double dt);

/* Bring the robot to rest, in equilibrium under controls: from its present shape, in smaller parts of the
 * change of the controls if needed. The time stays. */
int ${name}_equilibrium(${name}_robot *robot, const double *control);

/* Time (s). */
double ${name}_time(const ${name}_robot *robot);

/* Position (m) and orientation of a node: node 0 is the base, ${NAME}_NODES - 1 the tip. Either may be NULL. */
int ${name}_pose(const ${name}_robot *robot, int rod, int node, double *position, double *orientation);

/* Position (m) and orientation at a place, as part of the length from 0 to 1, between nodes by $between. */
int ${name}_pose_at(const ${name}_robot *robot, int rod, double place, double *position, double *orientation);

/* Position (m) of the tip. */
int ${name}_tip(const ${name}_robot *robot, double *position);

/* Force (N) and moment (N m) of a rod on its base, about the base's point, global frame. The pull of routed
 * tendons at the base is part of it. Not known for assemblies (BAD_ARGUMENT). */
int ${name}_base_wrench(const ${name}_robot *robot, int rod, double *force, double *moment);

/* 1 if the controls of the last step, or strains of the robot, are outside of the range from which the model
 * was learned by more than a tenth of it: there it extrapolates. Else 0, also if it was not learned. */
int ${name}_extrapolates(const ${name}_robot *robot);

/* Predict the tip (steps, 3) after each of a number of steps from the robot's state under controls
 * (steps, ${NAME}_CONTROLS), and its tangents (steps, 3, ${NAME}_CONTROLS) by the controls: the change of the
 * tip by a change of a control that is the same in all these steps. With 0 steps: at rest, in equilibrium
 * under controls (1, ${NAME}_CONTROLS). The robot itself does not move. Tips or tangents may be NULL. */
int ${name}_predict(const ${name}_robot *robot, ${name}_prediction *memory, int steps, const double *controls,
                    double *tips, double *tangents);

/* Save the state, and load it: into a robot that was started. Parameters are not part of it. */
int ${name}_save(const ${name}_robot *robot, double *saved);
int ${name}_load(${name}_robot *robot, const double *saved);

/* A result in words. */
const char *${name}_text(int result);

#ifdef __cplusplus
}
#endif
#endif
