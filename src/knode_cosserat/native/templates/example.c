/* Steps of $name under controls from standard input, one step a line; prints the time (s) and the tip (m).
 *
 *     cc example.c $name.c $name.o -lm -o example && ./example < controls.txt
 */
#include <stdio.h>
#include "$name.h"

static ${name}_robot robot;

int main(void) {
    double control[${NAME}_CONTROLS + 1], tip[3];
    ${name}_start(&robot);
    for (;;) {
        for (int k = 0; k < ${NAME}_CONTROLS; k++)
            if (scanf("%lf", control + k) != 1) return 0;
        if (${NAME}_CONTROLS == 0 && getchar() == EOF) return 0;
        int result = ${name}_step(&robot, control, ${NAME}_DT);
        if (result < 0) {
            fprintf(stderr, "t = %g s: %s\n", ${name}_time(&robot), ${name}_text(result));
            continue;
        }
        ${name}_tip(&robot, tip);
        printf("%.17g %.17g %.17g %.17g %d\n", ${name}_time(&robot), tip[0], tip[1], tip[2], result);
    }
}
