// Taring of one tendon: reel in until its load cell reacts, release until it settles, take that as zero.
#pragma once
#include <stdint.h>

#include "settings.h"

namespace tension {

class Tare {
  public:
    enum Result : uint8_t { RUNNING, DONE, FAILED };

    void start() {
        phase_ = REST;
        count_ = 0;
        sum_ = 0;
        total_ = 0;
    }

    int16_t drive() const { return drive_; }
    // Counts of the slack tendon, after DONE.
    int16_t zero() const { return zero_; }

    // Takes a reading (counts) and moves on by a tick.
    Result step(const Settings &s, int16_t count, int16_t gain) {
        if (++total_ > ticks(s.tare_time)) return stop(FAILED);
        switch (phase_) {
            case REST:
                sum_ += count;
                if (++count_ < MEAN) return RUNNING;
                base_ = static_cast<int16_t>(sum_ / MEAN);
                return begin(REEL_IN, s.tare_drive);
            case REEL_IN:
                if (count - base_ < rise(s, gain)) return RUNNING;
                return begin(RELEASE, static_cast<int16_t>(-s.tare_drive));
            case RELEASE:
                if (!is_settled(count)) return RUNNING;
                return begin(MEASURE, 0);
            case MEASURE:
            default:
                // the first readings still have the end of the motion
                if (++count_ <= MEAN) return RUNNING;
                sum_ += count;
                if (count_ < 3 * MEAN) return RUNNING;
                zero_ = static_cast<int16_t>(sum_ / (2 * MEAN));
                return stop(DONE);
        }
    }

  private:
    enum Phase : uint8_t { REST, REEL_IN, RELEASE, MEASURE };
    static const int16_t MEAN = 32;
    // readings within SETTLED counts for this many ticks: the tendon is slack
    static const int16_t STILL = 24;
    static const int16_t SETTLED = 12;

    static int16_t rise(const Settings &s, int16_t gain) {
        return static_cast<int16_t>(clamped_rise(4096L * s.tare_rise / gain));
    }
    static int32_t clamped_rise(int32_t counts) { return counts < 16 ? 16 : counts > 4000 ? 4000 : counts; }

    bool is_settled(int16_t count) {
        if (count_ == 0 || count < low_) low_ = count_ == 0 ? count : low_;
        if (count_ == 0) {
            low_ = high_ = count;
        } else {
            if (count < low_) low_ = count;
            if (count > high_) high_ = count;
        }
        ++count_;
        if (high_ - low_ > SETTLED) {
            count_ = 1;
            low_ = high_ = count;
        }
        return count_ >= STILL;
    }
    Result begin(Phase phase, int16_t drive) {
        phase_ = phase;
        drive_ = drive;
        count_ = 0;
        sum_ = 0;
        return RUNNING;
    }
    Result stop(Result result) {
        drive_ = 0;
        return result;
    }

    Phase phase_ = REST;
    int16_t drive_ = 0, zero_ = 0, base_ = 0, low_ = 0, high_ = 0, count_ = 0;
    uint16_t total_ = 0;
    int32_t sum_ = 0;
};

}  // namespace tension
