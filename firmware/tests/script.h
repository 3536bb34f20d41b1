// Runs a board by a script, the same on the chip and on a computer:
//   s            start (again)
//   r TEXT       the board receives the line TEXT
//   t N a b c d  N ticks with the readings a to d (counts); prints state, fault, drives and tensions (gf/8)
//   o N          opens (1) or closes (0) the contact of the emergency stop
//   p W M …      steps of a PID: wanted and measured tensions (gf/8); prints the drives
#pragma once
#ifdef __AVR__
#include <stddef.h>
inline void *operator new(size_t, void *place) { return place; }
#else
#include <new>
#endif

#include "../tension/board.h"

namespace tension {

class Script : public Port {
  public:
    typedef void (*Print)(const char *bytes, uint8_t length);

    explicit Script(Print print) : print_(print), board_(*this) {}

    void send(const char *bytes, uint8_t length) override {
        print_(">", 1);
        print_(bytes, length);
    }
    bool load(Stored &stored) override {
        stored = stored_;
        return true;
    }
    void save(const Stored &stored) override { stored_ = stored; }
    bool is_contact_open() override { return open_; }
    void set_contact(bool open) { open_ = open; }

    void run(char *line) {
        char *rest = line + (line[0] && line[1] ? 2 : 1);
        if (line[0] == 's') {
            board_.~Board();
            new (&board_) Board(*this);
            board_.start();
        } else if (line[0] == 'r') {
            while (*rest) board_.receive(*rest++);
            board_.receive('\n');
        } else if (line[0] == 't') {
            tick(Words(rest));
        } else if (line[0] == 'o') {
            set_contact(*rest == '1');
        } else if (line[0] == 'p') {
            steer(Words(rest));
        }
    }

    Board &board() { return board_; }

  private:
    void tick(Words words) {
        int32_t count = 0, value = 0;
        int16_t counts[TENDONS] = {0, 0, 0, 0};
        words.number(count);
        for (uint8_t k = 0; k < TENDONS; ++k)
            if (words.number(value)) counts[k] = static_cast<int16_t>(value);
        while (count-- > 0) board_.tick(counts);
        Text text;
        text.add(STATE_NAMES[board_.state()]).add(' ').add(FAULT_NAMES[board_.fault()]);
        for (uint8_t k = 0; k < TENDONS; ++k) text.add(' ').add(int32_t(board_.drive(k)));
        for (uint8_t k = 0; k < TENDONS; ++k) text.add(' ').add(int32_t(board_.tension(k)));
        text.add('\n');
        print_(text.bytes, text.length);
    }

    void steer(Words words) {
        Text text;
        int32_t wanted, measured;
        while (words.number(wanted) && words.number(measured))
            text.add(int32_t(pid_.step(board_.settings(), int16_t(wanted), int16_t(measured)))).add(' ');
        text.add('\n');
        print_(text.bytes, text.length);
    }

    Print print_;
    bool open_ = false;
    Stored stored_ = {};
    Board board_;
    Pid pid_;
};

}  // namespace tension
