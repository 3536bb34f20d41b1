/* Wrong input of all functions at random, for a number of seconds: built with sanitizers. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "arm.h"

static arm_robot robot, copy;
static arm_prediction prediction;
static double saved[ARM_SAVED], tips[3 * ARM_HORIZON], tangents[3 * ARM_HORIZON * (ARM_CONTROLS + 1)];

static double any(void) {
    static const double odd[] = {NAN, INFINITY, -INFINITY, 1e308, -1e308, 1e-320, 0.0, -0.0};
    int kind = rand() % 12;
    double unit = rand() / (double)RAND_MAX - 0.5;
    return kind < 2 ? odd[rand() % 8] : kind == 2 ? unit * 1e4 : unit * 4.0;
}

int main(int count, char **values) {
    double seconds = atof(values[1]), control[ARM_HORIZON * (ARM_CONTROLS + 1)], p[3], h[4];
    long calls = 0, solved = 0;
    time_t end = time(NULL) + (time_t)seconds;
    (void)count;
    srand((unsigned)atoi(values[2]));
    /* before the start */
    if (arm_step(&robot, control, ARM_DT) != ARM_BAD_STATE || arm_tip(&robot, p) != ARM_BAD_STATE) return 1;
    arm_start(&robot);
    while (time(NULL) < end) {
        int result = 0;
        for (size_t k = 0; k < sizeof control / sizeof *control; k++) control[k] = any();
        int calm = rand() % 3;
        for (size_t k = 0; calm && k < sizeof control / sizeof *control; k++) control[k] = 2.0 * (rand() % 100) / 100.0;
        copy = robot;
        switch (rand() % 9) {
        case 0: result = arm_step(&robot, control, rand() % 8 ? ARM_DT : any()); break;
        case 1: result = arm_equilibrium(&robot, control); break;
        case 2: result = arm_pose(&robot, rand() % 3 - 1, rand() % 14 - 2, p, rand() % 2 ? h : NULL); break;
        case 3: result = arm_pose_at(&robot, rand() % 2, any(), rand() % 2 ? p : NULL, h); break;
        case 4: result = arm_predict(&robot, &prediction, rand() % (ARM_HORIZON + 4) - 2, control,
                                     rand() % 2 ? tips : NULL, rand() % 2 ? tangents : NULL); break;
        case 5: arm_save(&robot, saved); if (rand() % 2) saved[rand() % ARM_SAVED] = any(); result = arm_load(&robot, saved); break;
        case 6: result = arm_base_wrench(&robot, rand() % 3 - 1, p, h); break;
        case 7: result = arm_step(&robot, control, ARM_DT); break;
        default: if (rand() % 20 == 0) arm_start(&robot);
        }
        if (!arm_text(result)) return 2;
        /* a call that failed moved nothing */
        if (result < 0 && memcmp(copy.motion, robot.motion, sizeof robot.motion)) return 3;
        if (arm_tip(&robot, p) < 0 || !isfinite(p[0] + p[1] + p[2])) return 4;
        calls++;
        solved += result >= 0;
    }
    printf("%ld calls, %ld solved\n", calls, solved);
    return 0;
}
