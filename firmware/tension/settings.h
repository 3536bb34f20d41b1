// Settings of the board: names, ranges, defaults, and their form in EEPROM.
#pragma once
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "line.h"

namespace tension {

const uint8_t TENDONS = 4;
// Ticks of the control loop in a second. A power of two, so that division by it is a shift.
const int16_t RATE = 256;

// Ticks of a time in milliseconds, at least one.
inline uint16_t ticks(uint16_t ms) {
    // 262/1024 is 256/1000 to 0.06 %, and needs no division
    const uint16_t count = static_cast<uint16_t>((static_cast<uint32_t>(ms) * 262 + 512) >> 10);
    return count ? count : 1;
}

struct Settings {
    // gains: 1/256 of a drive step per gf, per gf and s, per gf/s
    int16_t kp, ki, kd;
    // drive that holds a tension against the motor (1/256 drive per gf), and drive that overcomes friction
    int16_t hold, friction;
    // time constant with which the wanted tension follows the command (ms)
    int16_t smooth;
    // over-tension (gf)
    int16_t limit;
    // longest silence of the host (ms): framed, plain
    int16_t watchdog, silence;
    // reeling out after a fault (ms), and the tension of a slack tendon (gf)
    int16_t release, slack;
    // largest drive by hand
    int16_t jog;
    // drive (steps), time limit (ms) and rise of the reading (gf) of taring
    int16_t tare_drive, tare_time, tare_rise;
    // 1: tare after power-on
    int16_t tare_on_start;
    // 1: the contact of the emergency stop is watched
    int16_t estop;
    // time without a change, or without tension, until a sensor or tendon counts as broken (ms)
    int16_t stuck_time, slack_time;
    // calibration of each load cell: 1/4096 gf per count, and counts of a slack tendon
    int16_t gain[TENDONS], zero[TENDONS];
};

struct SettingRow {
    const char *name;
    uint8_t index;
    int16_t low, high, initial;
};

#define TENSION_INDEX(member) (offsetof(Settings, member) / sizeof(int16_t))
// Gains: for steps of stiff tendons, and for slow commands that bend the rod, on simulated motors with 3 N of
// friction. The loop becomes unstable at kp 100. Without `smooth`, steps overshoot by 40 % at these gains.
const SettingRow ROWS[] = {
    {"kp", TENSION_INDEX(kp), 0, 4000, 60},
    {"ki", TENSION_INDEX(ki), 0, 4000, 400},
    {"kd", TENSION_INDEX(kd), 0, 1000, 1},
    {"hold", TENSION_INDEX(hold), 0, 1000, 15},
    {"friction", TENSION_INDEX(friction), 0, 120, 18},
    {"smooth", TENSION_INDEX(smooth), 1, 250, 23},
    {"limit", TENSION_INDEX(limit), 50, 3500, 2300},
    {"watchdog", TENSION_INDEX(watchdog), 20, 500, 60},
    {"silence", TENSION_INDEX(silence), 100, 2000, 500},
    {"release", TENSION_INDEX(release), 50, 2000, 500},
    {"slack", TENSION_INDEX(slack), 2, 100, 10},
    {"jog", TENSION_INDEX(jog), 0, 255, 80},
    {"tare_drive", TENSION_INDEX(tare_drive), 10, 200, 50},
    {"tare_time", TENSION_INDEX(tare_time), 500, 20000, 5000},
    {"tare_rise", TENSION_INDEX(tare_rise), 10, 500, 40},
    {"tare_on_start", TENSION_INDEX(tare_on_start), 0, 1, 1},
    // on by default: lost settings must not turn off an emergency stop
    {"estop", TENSION_INDEX(estop), 0, 1, 1},
    {"stuck_time", TENSION_INDEX(stuck_time), 50, 2000, 250},
    {"slack_time", TENSION_INDEX(slack_time), 100, 5000, 1000},
    {"gain1", TENSION_INDEX(gain), 100, 32000, 2048},
    {"gain2", TENSION_INDEX(gain) + 1, 100, 32000, 2048},
    {"gain3", TENSION_INDEX(gain) + 2, 100, 32000, 2048},
    {"gain4", TENSION_INDEX(gain) + 3, 100, 32000, 2048},
    {"zero1", TENSION_INDEX(zero), 0, 8184, 800},
    {"zero2", TENSION_INDEX(zero) + 1, 0, 8184, 800},
    {"zero3", TENSION_INDEX(zero) + 2, 0, 8184, 800},
    {"zero4", TENSION_INDEX(zero) + 3, 0, 8184, 800},
};
const uint8_t SETTING_COUNT = sizeof(ROWS) / sizeof(ROWS[0]);
static_assert(SETTING_COUNT == sizeof(Settings) / sizeof(int16_t), "each setting has one row");

inline int16_t *value_of(Settings &settings, const SettingRow &row) {
    return reinterpret_cast<int16_t *>(&settings) + row.index;
}

inline const SettingRow *row_named(const char *name) {
    for (uint8_t k = 0; k < SETTING_COUNT; ++k)
        if (strcmp(ROWS[k].name, name) == 0) return &ROWS[k];
    return nullptr;
}

inline void set_defaults(Settings &settings) {
    for (uint8_t k = 0; k < SETTING_COUNT; ++k) *value_of(settings, ROWS[k]) = ROWS[k].initial;
}

// Settings as they are kept in EEPROM.
struct Stored {
    uint16_t version;
    Settings settings;
    uint16_t check;
};
const uint16_t STORED_VERSION = 3;

inline uint16_t check_of(const Stored &stored) {
    uint16_t crc = CRC_START;
    const uint8_t *bytes = reinterpret_cast<const uint8_t *>(&stored);
    for (size_t k = 0; k < offsetof(Stored, check); ++k) crc = crc16(crc, bytes[k]);
    return crc;
}

// True if the stored settings are complete and within their ranges.
inline bool is_valid(const Stored &stored) {
    if (stored.version != STORED_VERSION || stored.check != check_of(stored)) return false;
    Settings copy = stored.settings;
    for (uint8_t k = 0; k < SETTING_COUNT; ++k) {
        const int16_t value = *value_of(copy, ROWS[k]);
        if (value < ROWS[k].low || value > ROWS[k].high) return false;
    }
    return true;
}

}  // namespace tension
