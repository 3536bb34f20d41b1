/* Time of each step of an exported model under sines: median, 99.9 % and the longest (µs), and the last tip. */
#define _POSIX_C_SOURCE 199309L
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "robot.h"

enum { STEPS = 100000 };
static robot_robot robot;
static double times[STEPS];

static int in_order(const void *a, const void *b) {
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static double now(void) {
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return 1e6 * (double)at.tv_sec + 1e-3 * (double)at.tv_nsec;
}

int main(int count, char **values) {
    double control[ROBOT_CONTROLS + 1], tip[3];
    int steps = count > 1 ? atoi(values[1]) : STEPS;
    robot_start(&robot);
    for (int step = 0; step < steps; step++) {
        double t = (step + 1) * ROBOT_DT, ramp = t < 0.5 ? t / 0.5 : 1.0;
        for (int k = 0; k < ROBOT_CONTROLS; k++)
            control[k] = ramp * robot_amplitudes[k] * 0.5 * (1.0 + sin(2.0 * acos(-1.0) * t / 1.5 + k));
        double begun = now();
        if (robot_step(&robot, control, ROBOT_DT) < 0) return 1;
        times[step] = now() - begun;
    }
    qsort(times, (size_t)steps, sizeof *times, in_order);
    robot_tip(&robot, tip);
    printf("%.3f %.3f %.3f %.17g %.17g %.17g\n", times[steps / 2], times[(int)(0.999 * steps)], times[steps - 1], tip[0],
           tip[1], tip[2]);
    return 0;
}
