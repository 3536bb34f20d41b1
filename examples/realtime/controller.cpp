// Tip of a tendon robot on a circle: 500 periods a second, on the serial port of a tension board.
//
// controller PORT LAW [SECONDS]      LAW: kinematic or lq
//
// In each period it reads the board's telemetry, predicts the tip under the present tensions with the exported
// model `arm`, and changes them by du that minimises
//
//     sum |tip + J du - reference|^2 + rho |du|^2 + pull |tensions + du - PRETENSION|^2      (x and y of the tip)
//
// by one symmetric 4 x 4 system. J are the tangents of the tip. `kinematic` sums the tip at rest only: damped
// least squares. `lq` sums the tips of the next ARM_HORIZON periods in motion: linear-quadratic, so that it knows
// that the rod is late and swings. Tensions come LAG after their commands: so much earlier is the reference.
//
// The wire has tensions only, so that the model's state is not corrected by the tip: it moves by itself, under the
// tensions that were wanted. The board's tensions are led to them: their mean difference over some 0.5 s, from
// the telemetry, is taken off the commands. The board takes one command in a turn of its loop (256 a second), so
// every second period sends one: 20 characters at most, of which 576 lines a second fit on 115200 baud (of lines
// with 63 characters 180).
#include <cerrno>
#include <fcntl.h>
#include <poll.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <string>
#include <vector>

#include "arm.h"

namespace {

constexpr int n = ARM_CONTROLS;
static_assert(n == 4, "the board has four tendons");
using Tensions = std::array<double, n>;

constexpr double GRAM_FORCE = 9.80665e-3;                    // N
constexpr double PRETENSION = 3.0, LEAST = 0.5, MOST = 10.0;  // N
constexpr double RADIUS = 0.03, TURN = 4.0, GROWTH = 2.0;     // m, s for a turn, s until the radius is whole
constexpr double LAG = 0.03;                                  // s, of the board's tensions behind the commands
constexpr double SLOWNESS = 0.5, TELEMETRY = 0.02;            // s
constexpr double LARGEST_OFFSET = 1.0;                        // N
constexpr int EACH = 2;                                       // periods for one command on the wire

double now() {
    timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return static_cast<double>(t.tv_sec) + 1e-9 * static_cast<double>(t.tv_nsec);
}

void sleep_until(double due) {
    const double whole = std::floor(due);
    const timespec t = {static_cast<time_t>(whole), static_cast<long>(1e9 * (due - whole))};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, nullptr) == EINTR) {
    }
}

[[noreturn]] void fail(const std::string &why) {
    std::fprintf(stderr, "controller: %s\n", why.c_str());
    std::exit(1);
}

// The board in plain mode (firmware/PROTOCOL.md).
class Board {
  public:
    explicit Board(const char *path) : port_(open(path, O_RDWR | O_NOCTTY | O_NONBLOCK)) {
        termios settings;
        if (port_ < 0 || tcgetattr(port_, &settings) != 0) fail(std::string(path) + " is no serial port");
        cfmakeraw(&settings);
        cfsetspeed(&settings, B115200);
        tcsetattr(port_, TCSANOW, &settings);
        // lines from before a board was reset by this opening
        tcflush(port_, TCIOFLUSH);
    }
    ~Board() { close(port_); }
    Board(const Board &) = delete;
    Board &operator=(const Board &) = delete;

    // Wait until the board runs and has tared, and arm it by zero tensions.
    void arm() {
        const double end = now() + 30.0;
        while (!heard_) wait(end);
        write_line("hello 1\n");
        for (double quiet = now() + 0.3; now() < quiet; wait(end)) {
            if (refused_) quiet = now() + 0.3;
            refused_ = false;
            command({});
        }
    }

    void command(const Tensions &tensions) {
        char line[64];
        long whole[n];
        for (int k = 0; k < n; k++) whole[k] = std::lround(std::clamp(tensions[k], 0.0, MOST) / GRAM_FORCE);
        std::snprintf(line, sizeof line, "%ld %ld %ld %ld\n", whole[0], whole[1], whole[2], whole[3]);
        write_line(line);
    }

    // Read what has arrived; true if there are new measured tensions (N).
    bool read_lines(Tensions &measured) {
        bool is_new = false;
        char data[512];
        for (ssize_t count; (count = read(port_, data, sizeof data)) > 0;)
            for (const char *each = data; each < data + count; each++) {
                if (*each == '\n') {
                    is_new |= take(measured);
                    size_ = 0;
                } else if (size_ < sizeof line_ - 1) {
                    line_[size_++] = *each;
                }
            }
        return is_new;
    }

  private:
    bool take(Tensions &measured) {
        line_[size_] = 0;
        if (line_[0] == '!') {
            if (std::strstr(line_, "fault")) fail(std::string("the board says: ") + line_);
            refused_ = true;
        }
        int t[n], more[5];
        if (std::sscanf(line_, "%d,%d,%d,%d,%d,%d,%d,%d,%d", t, t + 1, t + 2, t + 3, more, more + 1, more + 2,
                        more + 3, more + 4) != 9) {
            // telemetry of framed mode has words before it
            heard_ |= std::strstr(line_, " : ") != nullptr;
            return false;
        }
        for (int k = 0; k < n; k++) measured[k] = GRAM_FORCE * t[k];
        return heard_ = true;
    }

    void wait(double end) {
        if (now() > end) fail("the board is silent, or refuses commands; is it taring, or in a fault?");
        pollfd events = {port_, POLLIN, 0};
        poll(&events, 1, 20);
        Tensions measured;
        read_lines(measured);
    }

    void write_line(const char *line) {
        // a full line loses the command: the next one is newer
        if (write(port_, line, std::strlen(line)) < 0 && errno != EAGAIN) fail("the board's port is closed");
    }

    int port_;
    char line_[128] = {};
    size_t size_ = 0;
    bool heard_ = false, refused_ = false;
};

// Solve the symmetric, positive definite system A x = b by Cholesky's factors.
Tensions solve(std::array<Tensions, n> A, Tensions x) {
    for (int j = 0; j < n; j++)
        for (int i = j; i < n; i++) {
            for (int k = 0; k < j; k++) A[i][j] -= A[i][k] * A[j][k];
            A[i][j] = i == j ? std::sqrt(A[j][j]) : A[i][j] / A[j][j];
        }
    for (int i = 0; i < n; i++) {
        for (int k = 0; k < i; k++) x[i] -= A[i][k] * x[k];
        x[i] /= A[i][i];
    }
    for (int i = n; i-- > 0;) {
        for (int k = i + 1; k < n; k++) x[i] -= A[k][i] * x[k];
        x[i] /= A[i][i];
    }
    return x;
}

// Where the tip shall be at a time (s): x and y (m) from where it rests.
std::array<double, 2> reference(double t) {
    const double radius = RADIUS * std::min(t / GROWTH, 1.0), angle = 2.0 * std::acos(-1.0) * t / TURN;
    return {radius * std::cos(angle), radius * std::sin(angle)};
}

class Controller {
  public:
    explicit Controller(const std::string &law) : steps_(law == "lq" ? ARM_HORIZON : 0) {
        if (law != "lq" && law != "kinematic") fail("the law is " + law + "; allowed is kinematic or lq");
        wanted.fill(PRETENSION);
        arm_start(robot_.get());
        check(arm_equilibrium(robot_.get(), wanted.data()));
        check(arm_tip(robot_.get(), rest_.data()));
    }

    // Change the wanted tensions (N) for the period that begins at a time (s).
    void decide(double t) {
        const int rows = std::max(steps_, 1);
        double controls[n * ARM_HORIZON], tips[3 * ARM_HORIZON], J[3 * n * ARM_HORIZON];
        for (int k = 0; k < rows; k++) std::copy(wanted.begin(), wanted.end(), controls + n * k);
        check(arm_predict(robot_.get(), memory_.get(), steps_, controls, tips, J));
        std::array<Tensions, n> A{};
        Tensions b{};
        for (int row = 0; row < rows; row++) {
            const auto target = reference(t + (row + 1) * ARM_DT);
            for (int axis = 0; axis < 2; axis++) {
                const double *gradient = J + n * (3 * row + axis);
                const double error = target[axis] + rest_[axis] - tips[3 * row + axis];
                for (int i = 0; i < n; i++) {
                    b[i] += gradient[i] * error;
                    for (int j = 0; j < n; j++) A[i][j] += gradient[i] * gradient[j];
                }
            }
        }
        const double size = A[0][0] + A[1][1] + A[2][2] + A[3][3], rho = 1e-2 * size, pull = 1e-4 * size;
        for (int i = 0; i < n; i++) {
            A[i][i] += rho + pull;
            b[i] += pull * (PRETENSION - wanted[i]);
        }
        const Tensions change = solve(A, b);
        for (int i = 0; i < n; i++) wanted[i] = std::clamp(wanted[i] + change[i], LEAST, MOST);
    }

    // Move the model by one period; returns the distance (m) of its tip from where it shall be.
    double move(double t) {
        check(arm_step(robot_.get(), wanted.data(), ARM_DT));
        std::array<double, 3> tip;
        check(arm_tip(robot_.get(), tip.data()));
        const auto target = reference(t + ARM_DT);
        return std::hypot(tip[0] - rest_[0] - target[0], tip[1] - rest_[1] - target[1]);
    }

    Tensions wanted;

  private:
    static void check(int result) {
        if (result < 0) fail(std::string("the model: ") + arm_text(result));
    }

    int steps_;
    std::array<double, 3> rest_;
    std::unique_ptr<arm_robot> robot_ = std::make_unique<arm_robot>();
    std::unique_ptr<arm_prediction> memory_ = std::make_unique<arm_prediction>();
};

void report(const char *name, std::vector<double> seconds) {
    std::sort(seconds.begin(), seconds.end());
    const size_t last = seconds.size() - 1, high = static_cast<size_t>(std::ceil(0.999 * static_cast<double>(last)));
    std::printf("%s_us %.0f %.0f %.0f\n", name, 1e6 * seconds[last / 2], 1e6 * seconds[high], 1e6 * seconds[last]);
}

}  // namespace

int main(int count, char **words) {
    if (count < 3) fail("usage: controller PORT kinematic|lq [SECONDS]");
    const double seconds = count > 3 ? std::atof(words[3]) : 10.0;
    if (!(seconds >= 0.1 && seconds <= 1e5)) fail("SECONDS must be a number from 0.1 to 1e5");
    const int periods = static_cast<int>(seconds / ARM_DT);
    Controller controller(words[2]);
    Board board(words[1]);
    board.arm();
    // to the pretension in a second, before the clock of the periods starts
    for (int k = 1; k <= 50; k++) {
        Tensions part;
        part.fill(PRETENSION * k / 50);
        board.command(part);
        sleep_until(now() + 0.02);
    }
    Tensions lagged, offset{}, measured{};
    lagged.fill(PRETENSION);
    board.read_lines(measured);  // those of the way there
    std::vector<double> wake, compute;
    wake.reserve(periods), compute.reserve(periods);
    int missed = 0, whole = 0, turn = 0;
    double squares = 0.0;
    const double start = now() + ARM_DT;
    for (int period = 0; period < periods;) {
        const double t = period * ARM_DT, due = start + t;
        sleep_until(due);
        const double began = now();
        if (board.read_lines(measured))
            for (int k = 0; k < n; k++)
                offset[k] = std::clamp(offset[k] + TELEMETRY / SLOWNESS * (measured[k] - lagged[k]), -LARGEST_OFFSET,
                                       LARGEST_OFFSET);
        controller.decide(t + LAG);
        Tensions sent;
        for (int k = 0; k < n; k++) sent[k] = controller.wanted[k] - offset[k];
        if (turn++ % EACH == 0) board.command(sent);
        double ended;
        // a period whose end has passed is left out, but for the model's step
        const int first = period;
        do {
            const double distance = controller.move(period * ARM_DT + LAG);
            for (int k = 0; k < n; k++) lagged[k] += ARM_DT / LAG * (controller.wanted[k] - lagged[k]);
            if (period * ARM_DT >= GROWTH) squares += distance * distance, whole++;
            ended = now();
        } while (++period < periods && ended > start + (period + 1) * ARM_DT);
        wake.push_back(began - due);
        compute.push_back(ended - began);
        missed += ended > due + ARM_DT ? period - first : 0;
    }
    board.command({});
    // times in µs: median, 99.9 %, largest
    std::printf("law %s\nstart %.6f\nperiods %d\nmissed %d\n", words[2], start, periods, missed);
    report("compute", compute);
    report("wake", wake);
    std::printf("model_rms_mm %.4f\n", whole ? 1e3 * std::sqrt(squares / whole) : 0.0);
    return 0;
}
