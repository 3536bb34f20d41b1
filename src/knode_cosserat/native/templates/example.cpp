// A kinematic controller of $name: the tip follows a small circle, by the tangents of the equilibria.
//
//     c++ -std=c++17 example.cpp $name.c... (compile $name.c as C), or CMakeLists.txt
#include <cmath>
#include <cstdio>
#include <memory>

#include "$name.h"

int main() {
    auto robot = std::make_unique<${name}_robot>();
    auto prediction = std::make_unique<${name}_prediction>();
    double control[${NAME}_CONTROLS + 1] = {}, tip[3], start[3], tangents[3 * ${NAME}_CONTROLS + 1];
    ${name}_start(robot.get());
    ${name}_tip(robot.get(), start);
    std::printf("starts at %.4f %.4f %.4f m\n", start[0], start[1], start[2]);
    int result = ${name}_predict(robot.get(), prediction.get(), 0, control, tip, tangents);
    if (result < 0) {
        std::fprintf(stderr, "%s\n", ${name}_text(result));
        return 1;
    }
    for (int k = 0; k < ${NAME}_CONTROLS; k++)
        std::printf("control %d moves the tip by %.3g %.3g %.3g m per unit\n", k, tangents[k],
                    tangents[${NAME}_CONTROLS + k], tangents[2 * ${NAME}_CONTROLS + k]);
    return 0;
}
