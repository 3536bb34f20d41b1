// Tension control of one tendon, in whole numbers. Tensions are in eighths of a gram-force.
#pragma once
#include <stdint.h>

#include "settings.h"

namespace tension {

inline int32_t clamped(int32_t value, int32_t low, int32_t high) {
    return value < low ? low : value > high ? high : value;
}

// Tension (gf/8) of a reading (counts).
inline int16_t tension_of(int16_t count, int16_t zero, int16_t gain) {
    // at most 8184 · 32000 = 2.6e8
    const int32_t eighths = (static_cast<int32_t>(count) - zero) * gain / 512;
    return static_cast<int16_t>(clamped(eighths, -32000, 32000));
}

// PID with feedforward, a derivative of the measurement only, and integration that stops where the drive
// saturates.
class Pid {
  public:
    static const int16_t FULL = 255;

    void reset(int16_t measured) {
        integral_ = slow_ = 0;
        target_ = 256L * measured;
        for (uint8_t k = 0; k < SPAN; ++k) before_[k] = measured;
        at_ = 0;
    }

    // Returns the drive, -255 to 255, for a tension (gf/8).
    int16_t step(const Settings &s, int16_t wanted, int16_t measured) {
        // the command is smoothed, so that the gains need not be low for the sake of its steps
        target_ += (256L * wanted - target_) / ticks(s.smooth);
        const int32_t target = target_ / 256;
        const int32_t error = clamped(target - measured, -16000, 16000);
        const int32_t change = clamped(static_cast<int32_t>(measured) - before_[at_], -4000, 4000);
        before_[at_] = measured;
        at_ = static_cast<uint8_t>((at_ + 1) % SPAN);
        // all in 1/256 of a drive step: at most 6.4e7 each
        const int32_t ahead = (s.hold * target + s.kp * error) / 8;
        // only fast changes are damped: slow ones, when the rod bends, would lag
        slow_ += change - slow_ / WASHOUT;
        const int32_t damping = s.kd * (change - slow_ / WASHOUT) * (RATE / SPAN) / 8;
        const int32_t against = 256L * s.friction * clamped(error, -BAND, BAND) / BAND;
        const int32_t drive = (ahead - damping + against + integral_ / 256) / 256;
        const bool saturated = (drive > FULL && error > 0) || (drive < -FULL && error < 0);
        if (!saturated) integral_ = clamped(integral_ + s.ki * error / 8, -LARGEST, LARGEST);
        return static_cast<int16_t>(clamped(drive, -FULL, FULL));
    }

  private:
    // ticks over which the derivative is taken
    static const uint8_t SPAN = 4;
    // ticks of the washout of the derivative (125 ms)
    static const int32_t WASHOUT = 32;
    // error (gf/8) from which on friction is compensated fully
    static const int32_t BAND = 48;
    // largest drive by the integral, in 1/65536 of a step
    static const int32_t LARGEST = 120L * 65536L;
    int32_t integral_ = 0, slow_ = 0, target_ = 0;
    int16_t before_[SPAN] = {0, 0, 0, 0};
    uint8_t at_ = 0;
};

}  // namespace tension
