// Detection of broken load cells and tendons, for one tendon.
#pragma once
#include <stdint.h>

#include "settings.h"

namespace tension {

enum Fault : uint8_t {
    NO_FAULT, OVER_TENSION, WATCHDOG, SENSOR_RAIL, SENSOR_STUCK, SLACK, TARE_TIMEOUT, STOPPED, BAD_SETTINGS,
    EMERGENCY_STOP
};
const char *const FAULT_NAMES[] = {"-",     "over-tension", "watchdog", "sensor-rail", "sensor-stuck",
                                   "slack", "tare-timeout", "stopped",  "settings",    "emergency-stop"};

class Monitor {
  public:
    // readings (counts) nearer to an end of the converter's range are at a rail
    static const int16_t RAIL = 16;
    static const int16_t TOP = 8 * 1023;
    // drive (steps) beyond that which holds the tension, from which on a motor moves
    static const int16_t MOVES = 25;
    // change (counts) of a reading that is alive
    static const int16_t ALIVE = 2;
    // consecutive readings that a fault of a value needs: one bad conversion is none
    static const uint8_t CONFIRMED = 3;

    void reset() { rail_ = over_ = 0, still_ = slack_ = 0; }

    // Checks a reading (counts, gf/8) under the drive of the last tick.
    Fault step(const Settings &s, int16_t count, int16_t tension, int16_t wanted, int16_t drive) {
        const bool at_rail = count <= RAIL || count >= TOP - RAIL;
        if (!confirmed(rail_, at_rail)) return SENSOR_RAIL;
        // the first reading of a broken cell may be the mean of conversions before and after
        if (!confirmed(over_, tension / 8 > s.limit)) return at_rail ? SENSOR_RAIL : OVER_TENSION;
        const int16_t effort = static_cast<int16_t>(drive - s.hold * static_cast<int32_t>(tension) / 2048);
        const int16_t moves = static_cast<int16_t>(s.friction + MOVES);
        const bool reels_in = effort > moves, reels_out = effort < -moves && tension / 8 > s.slack;
        const int16_t change = static_cast<int16_t>(count - last_);
        if (!(reels_in || reels_out) || change > ALIVE || change < -ALIVE) {
            still_ = 0;
            last_ = count;
        } else if (++still_ > ticks(s.stuck_time)) {
            // no tension at all is a missing tendon rather than a stuck sensor
            if (tension / 8 > s.slack) return SENSOR_STUCK;
            still_ = 0;
        }
        if (!reels_in || wanted / 8 <= s.slack || tension / 8 > s.slack) {
            slack_ = 0;
        } else if (++slack_ > ticks(s.slack_time)) {
            return SLACK;
        }
        return NO_FAULT;
    }

  private:
    // False once a condition held for CONFIRMED ticks.
    static bool confirmed(uint8_t &counter, bool condition) {
        counter = condition ? static_cast<uint8_t>(counter + 1) : 0;
        return counter < CONFIRMED;
    }
    uint8_t rail_ = 0, over_ = 0;
    uint16_t still_ = 0, slack_ = 0;
    int16_t last_ = 0;
};

}  // namespace tension
