// Script on the chip: lines come and results go by the serial port; `.` ends each result.
#include <avr/io.h>

#include "script.h"

namespace {

void put(char byte) {
    while (!(UCSR0A & _BV(UDRE0))) {
    }
    UDR0 = static_cast<uint8_t>(byte);
}

void print(const char *bytes, uint8_t length) {
    while (length--) put(*bytes++);
}

char get() {
    while (!(UCSR0A & _BV(RXC0))) {
    }
    return static_cast<char>(UDR0);
}

}  // namespace

int main() {
    UBRR0 = 16;  // 115200 baud with U2X
    UCSR0A = _BV(U2X0);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    static tension::Script script(print);
    print(".\n", 2);
    static char line[100];
    for (;;) {
        uint8_t length = 0;
        for (char byte = get(); byte != '\n'; byte = get())
            if (length < sizeof line - 1) line[length++] = byte;
        line[length] = 0;
        script.run(line);
        print(".\n", 2);
    }
}
