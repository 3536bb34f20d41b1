// The board: states, commands, telemetry. Pure logic, the same on the chip and on a computer.
#pragma once
#include <stdint.h>
#include <string.h>

#include "line.h"
#include "monitor.h"
#include "pid.h"
#include "settings.h"
#include "tare.h"

namespace tension {

#define TENSION_VERSION "1.0.0"

enum State : uint8_t { BOOT, TARING, READY, ARMED, RELEASING, FAULT };
const char *const STATE_NAMES[] = {"boot", "taring", "ready", "armed", "releasing", "fault"};

// The chip, as the board sees it.
class Port {
  public:
    virtual void send(const char *bytes, uint8_t length) = 0;
    virtual bool load(Stored &stored) = 0;
    virtual void save(const Stored &stored) = 0;
    // True if the contact of the emergency stop is open: the switch is pressed, or a wire is broken.
    virtual bool is_contact_open() = 0;
};

class Board {
  public:
    static const uint16_t TELEMETRY_TICKS = RATE / 50;

    explicit Board(Port &port) : port_(port) { memset(&settings_, 0, sizeof settings_); }

    // Reads the settings, sends the banner, and tares if the settings say so.
    void start() {
        Stored stored;
        const bool valid = port_.load(stored) && is_valid(stored);
        if (valid) settings_ = stored.settings;
        else set_defaults(settings_);
        Text text;
        finish(text.add("# knode-tension " TENSION_VERSION " protocol 2 tendons ").add(int32_t(TENDONS)), false);
        if (!valid) latch(BAD_SETTINGS, 0);
        else if (is_pressed()) latch(EMERGENCY_STOP, 0);
        else if (settings_.tare_on_start) begin_tare();
        else state_ = READY;
    }

    // Takes a received byte.
    void receive(char byte) {
        const LineBuffer::Status status = line_.take(byte);
        if (status != LineBuffer::PENDING) sequence_ = 0;
        switch (status) {
            case LineBuffer::COMPLETE: handle(); break;
            case LineBuffer::TOO_LONG: refuse("long"); break;
            case LineBuffer::NOT_TEXT: refuse("frame"); break;
            default: break;
        }
    }

    // Moves on by a tick with the readings of the load cells (counts). `elapsed` is the number of ticks since the
    // last call; it is above one if the chip was too slow.
    void tick(const int16_t *counts, uint8_t elapsed = 1) {
        if (elapsed > slowest_) slowest_ = elapsed;
        for (uint8_t k = 0; k < TENDONS; ++k) {
            counts_[k] = counts[k];
            tension_[k] = tension_of(counts[k], settings_.zero[k], settings_.gain[k]);
        }
        check_emergency_stop();
        check_host();
        check_sensors();
        move();
        if (++since_telemetry_ >= TELEMETRY_TICKS) {
            since_telemetry_ = 0;
            send_telemetry();
        }
    }

    int16_t drive(uint8_t tendon) const { return drive_[tendon]; }
    int16_t tension(uint8_t tendon) const { return tension_[tendon]; }
    State state() const { return state_; }
    Fault fault() const { return fault_; }
    bool is_framed() const { return framed_; }
    const Settings &settings() const { return settings_; }

  private:
    // --- motion ---
    void move() {
        switch (state_) {
            case TARING: move_tare(); break;
            case ARMED:
                for (uint8_t k = 0; k < TENDONS; ++k) drive_[k] = controlled(k);
                break;
            case RELEASING: move_release(); break;
            case READY:
                if (jog_left_ && --jog_left_ == 0) stop_motors();
                break;
            default: stop_motors();
        }
    }

    int16_t controlled(uint8_t k) {
        const int16_t drive = pid_[k].step(settings_, wanted_[k], tension_[k]);
        // a slack tendon is not reeled out further
        if (drive < 0 && tension_[k] <= 8 * settings_.slack) {
            if (wanted_[k] == 0) pid_[k].reset(tension_[k]);
            return 0;
        }
        return drive;
    }

    void move_tare() {
        const Tare::Result result =
            tare_.step(settings_, counts_[tared_], settings_.gain[tared_]);
        drive_[tared_] = tare_.drive();
        if (result == Tare::FAILED) return latch(TARE_TIMEOUT, tared_ + 1);
        if (result == Tare::RUNNING) return;
        settings_.zero[tared_] = tare_.zero();
        if (++tared_ < TENDONS) return tare_.start();
        state_ = READY;
    }

    void move_release() {
        // a broken sensor cannot tell when its tendon is slack
        const bool blind = fault_ == SENSOR_RAIL || fault_ == SENSOR_STUCK;
        for (uint8_t k = 0; k < TENDONS; ++k) {
            const bool unknown = blind && (fault_tendon_ == 0 || fault_tendon_ == k + 1);
            drive_[k] = unknown || tension_[k] > 8 * settings_.slack ? -Pid::FULL : 0;
        }
        if (--release_left_ > 0) return;
        stop_motors();
        state_ = fault_ == NO_FAULT ? READY : FAULT;
    }

    void stop_motors() {
        for (uint8_t k = 0; k < TENDONS; ++k) drive_[k] = 0;
        jog_left_ = 0;
    }

    void begin_tare() {
        stop_motors();
        state_ = TARING;
        tared_ = 0;
        silent_ = 0;
        tare_.start();
    }

    void begin_release() {
        stop_motors();
        for (uint8_t k = 0; k < TENDONS; ++k) wanted_[k] = 0;
        release_left_ = static_cast<int16_t>(ticks(settings_.release));
        state_ = RELEASING;
    }

    void arm() {
        for (uint8_t k = 0; k < TENDONS; ++k) {
            wanted_[k] = 0;
            pid_[k].reset(tension_[k]);
            monitor_[k].reset();
        }
        jog_left_ = 0;
        silent_ = 0;
        state_ = ARMED;
    }

    // --- faults ---
    void latch(Fault fault, uint8_t tendon) {
        if (fault_ != NO_FAULT) return;
        fault_ = fault;
        fault_tendon_ = tendon;
        if (state_ == BOOT) state_ = FAULT;
        else begin_release();
        Text text;
        if (framed_) text.add(int32_t(0)).add(' ');
        text.add("! fault ").add(FAULT_NAMES[fault]).add(':').add(int32_t(tendon));
        finish(text, framed_);
    }

    bool is_pressed() { return settings_.estop && port_.is_contact_open(); }

    // Motors stop at once and are not released: after an emergency stop nothing moves by itself.
    void check_emergency_stop() {
        if (!is_pressed()) return;
        latch(EMERGENCY_STOP, 0);
        stop_motors();
        state_ = FAULT;
    }

    void check_host() {
        if (state_ != ARMED && !(state_ == TARING && framed_)) return;
        if (++silent_ <= ticks(framed_ ? settings_.watchdog : settings_.silence)) return;
        if (framed_) latch(WATCHDOG, 0);
        else begin_release();
    }

    void check_sensors() {
        if (state_ == BOOT || state_ == RELEASING || state_ == FAULT) return;
        for (uint8_t k = 0; k < TENDONS; ++k) {
            const int16_t wanted = state_ == ARMED ? wanted_[k] : 0;
            const Fault found = monitor_[k].step(settings_, counts_[k], tension_[k], wanted, drive_[k]);
            if (found == NO_FAULT) continue;
            // before the first tare nothing is known of the zeros
            if (state_ == TARING && found != SENSOR_RAIL) continue;
            return latch(found, k + 1);
        }
    }

    // --- lines ---
    void handle() {
        char *text = line_.text;
        if (strcmp(text, "stop") == 0) return stop();
        if (strncmp(text, "hello ", 6) == 0) return hello(text + 6, 0);
        if (framed_) return handle_frame();
        if (strcmp(text, "reset") == 0) return reset();
        set_tensions(text);
    }

    void handle_frame() {
        char *text = line_.text;
        char *star = strrchr(text, '*');
        if (!star || strlen(star) != 5) return refuse("frame");
        uint16_t sent = 0;
        for (uint8_t k = 1; k < 5; ++k) {
            const int8_t digit = hex_value(star[k]);
            if (digit < 0) return refuse("checksum");
            sent = static_cast<uint16_t>(sent << 4 | static_cast<uint16_t>(digit));
        }
        if (sent != crc16(text, static_cast<uint8_t>(star - text))) return refuse("checksum");
        *star = 0;
        Words words(text);
        int32_t number;
        if (!words.number(number) || number < 0 || number > 65535) return refuse("frame");
        sequence_ = static_cast<uint16_t>(number);
        // the difference wraps, as the numbers do
        const int16_t newer = static_cast<int16_t>(static_cast<uint16_t>(sequence_ - last_));
        if (counted_ && newer <= 0) return refuse("order");
        counted_ = true;
        last_ = sequence_;
        silent_ = 0;
        const char *verb = words.next();
        if (!verb) return refuse("verb");
        obey(verb, words);
    }

    void obey(const char *verb, Words &words) {
        if (strcmp(verb, "tension") == 0) return set_tensions(words);
        if (strcmp(verb, "drive") == 0) return jog(words);
        if (strcmp(verb, "get") == 0 || strcmp(verb, "set") == 0) return setting(verb, words);
        if (strcmp(verb, "hello") == 0) {
            char *version = words.next();
            return version ? hello(version, sequence_) : refuse("arguments");
        }
        if (!words.is_empty()) return refuse("arguments");
        const bool at_rest = (state_ == READY && !jog_left_) || state_ == FAULT;
        if (strcmp(verb, "keep") == 0) return;
        if (strcmp(verb, "arm") == 0) return state_ == READY ? (arm(), answer(verb)) : refuse("state");
        if (strcmp(verb, "disarm") == 0) return state_ == ARMED ? (begin_release(), answer(verb)) : refuse("state");
        if (strcmp(verb, "tare") == 0) return state_ == READY ? (begin_tare(), answer(verb)) : refuse("state");
        if (strcmp(verb, "stop") == 0) return stop();
        if (strcmp(verb, "reset") == 0) return reset();
        if (strcmp(verb, "save") == 0) return at_rest ? (save(), answer(verb)) : refuse("state");
        if (strcmp(verb, "defaults") == 0) return at_rest ? (set_defaults(settings_), answer(verb)) : refuse("state");
        refuse("verb");
    }

    // Plain commands: the whole line is four numbers.
    void set_tensions(char *text) {
        Words words(text);
        int32_t values[TENDONS];
        if (!read_tensions(words, values)) return;
        if (state_ == READY) arm();
        if (state_ != ARMED) return refuse("state");
        silent_ = 0;
        take(values);
    }

    void set_tensions(Words &words) {
        int32_t values[TENDONS];
        if (!read_tensions(words, values)) return;
        if (state_ != ARMED) return refuse("state");
        take(values);
    }

    // Reads four tensions (gf); answers and returns false if they are not allowed.
    bool read_tensions(Words &words, int32_t *values) {
        for (uint8_t k = 0; k < TENDONS; ++k)
            if (!words.number(values[k])) return refuse("arguments"), false;
        if (!words.is_empty()) return refuse("arguments"), false;
        for (uint8_t k = 0; k < TENDONS; ++k)
            if (values[k] < 0 || values[k] > settings_.limit) return refuse("range"), false;
        return true;
    }

    void take(const int32_t *values) {
        for (uint8_t k = 0; k < TENDONS; ++k) wanted_[k] = static_cast<int16_t>(8 * values[k]);
    }

    void jog(Words &words) {
        int32_t tendon, drive;
        if (!words.number(tendon) || !words.number(drive) || !words.is_empty()) return refuse("arguments");
        if (tendon < 1 || tendon > TENDONS || drive < -settings_.jog || drive > settings_.jog) return refuse("range");
        if (state_ != READY) return refuse("state");
        stop_motors();
        drive_[tendon - 1] = static_cast<int16_t>(drive);
        jog_left_ = ticks(100);
        answer("drive");
    }

    void setting(const char *verb, Words &words) {
        const char *name = words.next();
        const SettingRow *row = name ? row_named(name) : nullptr;
        if (!row) return refuse("name");
        int16_t &value = *value_of(settings_, *row);
        if (verb[0] == 's') {
            int32_t given;
            if (!words.number(given)) return refuse("arguments");
            if (given < row->low || given > row->high) return refuse("range");
            if ((state_ != READY || jog_left_) && state_ != FAULT) return refuse("state");
            if (!words.is_empty()) return refuse("arguments");
            value = static_cast<int16_t>(given);
        } else if (!words.is_empty()) {
            return refuse("arguments");
        }
        Text text;
        text.add(int32_t(sequence_)).add(" = ").add(verb).add(' ').add(row->name).add(' ').add(int32_t(value));
        finish(text, framed_);
    }

    void hello(const char *version, uint16_t sequence) {
        if (strcmp(version, "1") != 0 && strcmp(version, "2") != 0) return refuse("arguments");
        // a change of host must not leave the old one's tensions
        if (state_ == ARMED) begin_release();
        framed_ = version[0] == '2';
        counted_ = sequence != 0;
        silent_ = 0;
        Text text;
        if (framed_) text.add(int32_t(sequence)).add(" = ");
        else text.add("# ");
        text.add("hello ").add(version).add(" knode-tension " TENSION_VERSION " ").add(int32_t(TENDONS));
        text.add(' ').add(int32_t(RATE)).add(' ').add(int32_t(settings_.limit));
        finish(text, framed_);
    }

    void stop() {
        silent_ = 0;
        if (fault_ == NO_FAULT) latch(STOPPED, 0);
    }

    void reset() {
        if (state_ != FAULT) return refuse("state");
        if (is_pressed()) return refuse(FAULT_NAMES[EMERGENCY_STOP]);
        fault_ = NO_FAULT;
        fault_tendon_ = 0;
        for (uint8_t k = 0; k < TENDONS; ++k) monitor_[k].reset();
        state_ = READY;
        if (framed_) answer("reset");
    }

    void save() {
        Stored stored;
        memset(&stored, 0, sizeof stored);
        stored.version = STORED_VERSION;
        stored.settings = settings_;
        stored.check = check_of(stored);
        port_.save(stored);
    }

    // --- answers ---
    void answer(const char *verb) {
        Text text;
        finish(text.add(int32_t(sequence_)).add(" = ").add(verb), true);
    }

    void refuse(const char *reason) {
        Text text;
        if (framed_) text.add(int32_t(sequence_)).add(' ');
        finish(text.add("! ").add(reason), framed_);
    }

    void send_telemetry() {
        Text text;
        if (framed_) {
            text.add(int32_t(telemetry_++)).add(" : ").add(int32_t(last_)).add(' ');
            text.add(STATE_NAMES[state_]).add(' ').add(FAULT_NAMES[fault_]);
            if (fault_ != NO_FAULT) text.add(':').add(int32_t(fault_tendon_));
            text.add(' ');
        }
        for (uint8_t k = 0; k < TENDONS; ++k) text.add(int32_t((tension_[k] + (tension_[k] < 0 ? -4 : 4)) / 8)).add(',');
        for (uint8_t k = 0; k < TENDONS; ++k) text.add(int32_t(drive_[k])).add(',');
        // the longest time between two ticks since the last telemetry (ms)
        finish(text.add(int32_t((slowest_ * 1000L + RATE / 2) / RATE)), framed_);
        slowest_ = 0;
    }

    void finish(Text &text, bool sealed) {
        if (sealed) text.seal();
        text.add('\n');
        port_.send(text.bytes, text.length);
    }

    Port &port_;
    Settings settings_;
    LineBuffer line_;
    Pid pid_[TENDONS];
    Monitor monitor_[TENDONS];
    Tare tare_;
    State state_ = BOOT;
    Fault fault_ = NO_FAULT;
    uint8_t fault_tendon_ = 0, tared_ = 0, slowest_ = 0;
    bool framed_ = false, counted_ = false;
    uint16_t sequence_ = 0, last_ = 0, telemetry_ = 0, silent_ = 0, since_telemetry_ = 0, jog_left_ = 0;
    int16_t release_left_ = 0;
    int16_t counts_[TENDONS] = {0, 0, 0, 0}, tension_[TENDONS] = {0, 0, 0, 0};
    int16_t wanted_[TENDONS] = {0, 0, 0, 0}, drive_[TENDONS] = {0, 0, 0, 0};
};

}  // namespace tension
