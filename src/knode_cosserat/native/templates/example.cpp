// A kinematic controller: the tip of $name follows a circle, by the tangents of its equilibria.
//
// Prints the time (s), the tip and where it shall be (m). Build it with CMakeLists.txt.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <memory>

#include "$name.h"

constexpr int n = ${NAME}_CONTROLS;

// Solve the symmetric 3 x 3 system A x = b by Cramer's rule.
static void solve(const double A[3][3], const double b[3], double x[3]) {
    auto det = [](const double M[3][3]) {
        return M[0][0] * (M[1][1] * M[2][2] - M[1][2] * M[2][1]) - M[0][1] * (M[1][0] * M[2][2] - M[1][2] * M[2][0]) +
               M[0][2] * (M[1][0] * M[2][1] - M[1][1] * M[2][0]);
    };
    for (int k = 0; k < 3; k++) {
        double M[3][3];
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) M[i][j] = j == k ? b[i] : A[i][j];
        x[k] = det(M) / det(A);
    }
}

int main() {
    auto robot = std::make_unique<${name}_robot>();
    auto memory = std::make_unique<${name}_prediction>();
    double control[n + 1] = {}, J[3 * n + 1], still[3], start[3], tip[3];
    for (int k = 0; k < n; k++) control[k] = std::clamp(0.0, ${name}_low[k], ${name}_high[k]);
    ${name}_start(robot.get());
    ${name}_tip(robot.get(), start);
    const double radius = 0.05 * $length, turn = 2.0 * std::acos(-1.0) / 200.0;
    for (int step = 1; step <= 200; step++) {
        const double target[3] = {start[0] + radius * (std::cos(step * turn) - 1.0),
                                  start[1] + radius * std::sin(step * turn), start[2]};
        int result = ${name}_predict(robot.get(), memory.get(), 0, control, still, J);
        if (result >= 0) {
            // the change of the controls by damped least squares: J' (J J' + d I)^-1 (target - still)
            double A[3][3], error[3], x[3], size = 0.0;
            for (int k = 0; k < 3 * n; k++) size += J[k] * J[k];
            for (int i = 0; i < 3; i++) {
                error[i] = target[i] - still[i];
                for (int j = 0; j < 3; j++) {
                    A[i][j] = i == j ? 1e-3 * size : 0.0;
                    for (int k = 0; k < n; k++) A[i][j] += J[i * n + k] * J[j * n + k];
                }
            }
            solve(A, error, x);
            for (int k = 0; k < n; k++) {
                for (int i = 0; i < 3; i++) control[k] += J[i * n + k] * x[i];
                control[k] = std::clamp(control[k], ${name}_low[k], ${name}_high[k]);
            }
            result = ${name}_step(robot.get(), control, ${NAME}_DT);
        }
        if (result < 0) {
            std::fprintf(stderr, "t = %g s: %s\n", ${name}_time(robot.get()), ${name}_text(result));
            return 1;
        }
        ${name}_tip(robot.get(), tip);
        std::printf("%g %.6f %.6f %.6f %.6f %.6f %.6f\n", ${name}_time(robot.get()), tip[0], tip[1], tip[2], target[0],
                    target[1], target[2]);
    }
    return 0;
}
