/* Steps of a model, its equilibria and predictions where no memory can be allocated. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#include "arm.h"

static int calls;

void *malloc(size_t size) { (void)size; calls++; return NULL; }
void *calloc(size_t count, size_t size) { (void)count; (void)size; calls++; return NULL; }
void *realloc(void *old, size_t size) { (void)old; (void)size; calls++; return NULL; }
void free(void *old) { (void)old; }

static arm_robot robot;
static arm_prediction prediction;

int main(void) {
    double control[4 * (ARM_CONTROLS + 1)] = {1.0, 0.5}, tips[12], tangents[12 * (ARM_CONTROLS + 1)];
    arm_start(&robot);
    for (int k = 0; k < 20; k++)
        if (arm_step(&robot, control, ARM_DT) < 0) return 1;
    if (arm_predict(&robot, &prediction, 4, control, tips, tangents) < 0) return 2;
    if (arm_equilibrium(&robot, control) < 0) return 3;
    return calls ? 4 : 0;
}
