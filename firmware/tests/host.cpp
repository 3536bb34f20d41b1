// The board's logic on this computer: scripts, and a fuzzer that checks what the motors may do.
#include <stdio.h>
#include <stdlib.h>

#include <string>

#include "script.h"

using namespace tension;

namespace {

std::string *printed = nullptr;
void print(const char *bytes, uint8_t length) { printed->append(bytes, length); }
void drop(const char *, uint8_t) {}

struct Host {
    std::string text;
    Script script;
    Host() : script(print) {}
};

// xorshift: the same numbers everywhere
struct Random {
    uint64_t state;
    uint32_t next() {
        state ^= state << 13, state ^= state >> 7, state ^= state << 17;
        return static_cast<uint32_t>(state >> 32);
    }
    uint32_t below(uint32_t limit) { return next() % limit; }
};

const char *const WORDS[] = {"tension", "arm",  "disarm", "stop", "reset", "tare", "keep", "get", "set", "save",
                             "defaults", "hello", "drive", "kp", "estop", "limit", "zero1", "gain2", "watchdog", "-1", "0",
                             "100", "2300", "2301", "65535", "99999", "123456", "*", "1", "2", "3", "-80", "80"};

// A line that is often almost right.
std::string frame(Random &random, uint16_t &sequence) {
    std::string body;
    const bool framed = random.below(4) != 0;
    if (framed) body = std::to_string(random.below(8) ? ++sequence : random.below(70000)) + " ";
    switch (random.below(8)) {
        case 0: body += "tension"; break;
        case 1: body += "arm"; break;
        case 2: body += "keep"; break;
        default: body += WORDS[random.below(sizeof WORDS / sizeof *WORDS)];
    }
    if (!framed && random.below(2)) body.clear();
    for (uint32_t k = random.below(6); k > 0; --k)
        body += " " + (random.below(2) ? std::to_string(random.below(2600)) : WORDS[random.below(sizeof WORDS / sizeof *WORDS)]);
    if (framed && random.below(8)) {
        char text[6];
        snprintf(text, sizeof text, "*%04X", crc16(body.data(), static_cast<uint8_t>(body.size())));
        body += text;
    }
    // damage: a changed, lost or doubled byte
    if (!body.empty() && random.below(5) == 0) {
        const size_t at = random.below(static_cast<uint32_t>(body.size()));
        switch (random.below(3)) {
            case 0: body[at] = static_cast<char>(random.below(256)); break;
            case 1: body.erase(at, 1); break;
            default: body.insert(at, 1, body[at]);
        }
    }
    return body + (random.below(50) ? "\n" : "");
}

// True if the motors do what the state allows. `open`: the contact of the emergency stop has been open for a tick.
bool is_safe(const Board &board, bool open = false) {
    if (open && board.settings().estop && (board.state() != FAULT || board.fault() == NO_FAULT)) return false;
    for (uint8_t k = 0; k < TENDONS; ++k) {
        const int16_t drive = board.drive(k);
        if (drive < -255 || drive > 255) return false;
        switch (board.state()) {
            case BOOT:
            case FAULT:
                if (drive != 0) return false;
                break;
            case RELEASING:
                if (drive > 0) return false;
                break;
            case READY:
            case TARING:
                // by hand, and while taring: within their settings
                if (drive > board.settings().jog && drive > board.settings().tare_drive) return false;
                break;
            case ARMED:
                if (board.fault() != NO_FAULT) return false;
        }
    }
    return true;
}

}  // namespace

extern "C" {

void *host_open() { return new Host; }
void host_close(void *host) { delete static_cast<Host *>(host); }

const char *host_run(void *host, const char *line) {
    Host &self = *static_cast<Host *>(host);
    self.text.clear();
    printed = &self.text;
    std::string copy(line);
    copy.push_back(0);
    self.script.run(&copy[0]);
    return self.text.c_str();
}

// Sends frames that are random or almost right, with readings that wander, and returns the number after which the
// motors did what the state does not allow. `armed` counts the ticks in which the board was armed.
uint64_t host_fuzz(uint64_t seed, uint64_t frames, uint64_t *armed) {
    Random random = {seed * 2654435761u + 88172645463325252ull};
    Script script(drop);
    char start[] = "s";
    script.run(start);
    Board &board = script.board();
    uint16_t sequence = 0;
    int16_t counts[TENDONS] = {800, 800, 800, 800};
    uint64_t unsafe = 0;
    bool open = false;
    for (uint64_t k = 0; k < frames; ++k) {
        std::string line = frame(random, sequence);
        if (random.below(64) == 0) line = random.below(2) ? "hello 2\n" : random.below(2) ? "hello 1\n" : "stop\n";
        if (board.state() == FAULT && random.below(2)) {
            std::string body = std::to_string(++sequence) + " reset";
            char text[6];
            snprintf(text, sizeof text, "*%04X", crc16(body.data(), static_cast<uint8_t>(body.size())));
            line = board.is_framed() ? body + text + "\n" : "reset\n";
        }
        script.set_contact(open = open ? random.below(8) : random.below(2000) == 0);
        for (const char byte : line) board.receive(byte);
        bool bad = !is_safe(board);
        for (uint32_t ticks = random.below(4); ticks > 0; --ticks) {
            for (uint8_t c = 0; c < TENDONS; ++c) {
                int32_t next = counts[c] + int32_t(random.below(41)) - 20;
                if (random.below(2000) == 0) next = int32_t(random.below(8185));
                counts[c] = static_cast<int16_t>(next < 0 ? 0 : next > 8184 ? 8184 : next);
                if (counts[c] > 4000) counts[c] = static_cast<int16_t>(counts[c] - 40);
            }
            board.tick(counts);
            if (board.state() == ARMED) ++*armed;
            bad = bad || !is_safe(board, open);
        }
        unsafe += bad;
    }
    return unsafe;
}
}
