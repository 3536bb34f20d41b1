// Tension board on an Arduino Mega 2560: converter, motors, serial port and EEPROM around tension::Board.
#include <Arduino.h>
#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/sleep.h>

#include "tension/board.h"

using namespace tension;

namespace {

// Bridges: compare registers of timers 1 and 3 (pins 11, 12, 5, 2), and two direction pins each on port A (22 to 29).
const uint8_t PWM_PINS[TENDONS] = {11, 12, 5, 2};
volatile uint16_t *const COMPARE[TENDONS] = {&OCR1A, &OCR1B, &OCR3A, &OCR3B};
// 16 MHz / 4000 = 4 kHz: the bridges take up to 10 kHz
const uint16_t TOP_OF_PWM = 3999;
// conversions of a channel in a tick: 4 · 8 conversions take 3.3 of 3.9 ms
const uint8_t CONVERSIONS = 8;
// contact of the emergency stop on pin 18 (port D, bit 3): normally closed, to GND
const uint8_t CONTACT_PIN = 18, CONTACT_BIT = 3;
// ticks without the main loop after which the motors are stopped (100 ms)
const uint8_t LATE_TICKS = 26;

volatile uint16_t sums[TENDONS];
volatile uint8_t conversions_left = 0;
volatile uint8_t ticks_due = 0;
int16_t readings[TENDONS];

void set_motor(uint8_t tendon, int16_t drive) {
    const uint8_t shift = static_cast<uint8_t>(2 * tendon);
    const uint8_t mask = static_cast<uint8_t>(3 << shift);
    const uint8_t direction = static_cast<uint8_t>((drive > 0 ? 1 : drive < 0 ? 2 : 0) << shift);
    const uint16_t size = static_cast<uint16_t>(drive < 0 ? -drive : drive);
    // off before the direction changes
    const uint8_t now = PORTA & mask;
    if (now != direction) {
        *COMPARE[tendon] = 0;
        PORTA = static_cast<uint8_t>((PORTA & ~mask) | direction);
    }
    *COMPARE[tendon] = static_cast<uint16_t>(static_cast<uint32_t>(size) * TOP_OF_PWM / Pid::FULL);
}

// Bytes that wait for the serial port, so that the control loop never does.
class SerialPort : public Port {
  public:
    void send(const char *bytes, uint8_t length) override {
        // a line that does not fit is dropped as a whole
        if (static_cast<uint16_t>(SIZE - 1 - used()) < length) return;
        for (uint8_t k = 0; k < length; ++k) {
            queue_[head_] = bytes[k];
            head_ = static_cast<uint16_t>((head_ + 1) % SIZE);
        }
    }
    bool load(Stored &stored) override {
        eeprom_read_block(&stored, nullptr, sizeof stored);
        return true;
    }
    void save(const Stored &stored) override { eeprom_update_block(&stored, nullptr, sizeof stored); }
    // an open contact leaves the pin to its pull-up
    bool is_contact_open() override { return PIND & _BV(CONTACT_BIT); }
    void drain() {
        while (tail_ != head_ && Serial.availableForWrite() > 0) {
            Serial.write(queue_[tail_]);
            tail_ = static_cast<uint16_t>((tail_ + 1) % SIZE);
        }
    }

  private:
    static const uint16_t SIZE = 512;
    uint16_t used() const { return static_cast<uint16_t>((head_ + SIZE - tail_) % SIZE); }
    char queue_[SIZE];
    uint16_t head_ = 0, tail_ = 0;
};

SerialPort port;
Board board(port);

void start_motors() {
    DDRA = 0xFF;
    PORTA = 0;
    for (uint8_t k = 0; k < TENDONS; ++k) pinMode(PWM_PINS[k], OUTPUT);
    // fast PWM with the top in ICR (mode 14), no prescaler
    TCCR1A = _BV(COM1A1) | _BV(COM1B1) | _BV(WGM11);
    TCCR1B = _BV(WGM13) | _BV(WGM12) | _BV(CS10);
    ICR1 = TOP_OF_PWM;
    TCCR3A = _BV(COM3A1) | _BV(COM3B1) | _BV(WGM31);
    TCCR3B = _BV(WGM33) | _BV(WGM32) | _BV(CS30);
    ICR3 = TOP_OF_PWM;
}

void start_converter() {
    ADMUX = _BV(REFS0);
    ADCSRB = 0;
    ADCSRA = _BV(ADEN) | _BV(ADIE) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0);
}

// 16 MHz / 62500 = 256 Hz
void start_clock() {
    TCCR5A = 0;
    TCCR5B = _BV(WGM52) | _BV(CS50);
    OCR5A = 62499;
    TIMSK5 = _BV(OCIE5A);
}

}  // namespace

ISR(ADC_vect) {
    const uint8_t channel = static_cast<uint8_t>(conversions_left & 3);
    sums[channel] = static_cast<uint16_t>(sums[channel] + ADC);
    if (--conversions_left == 0) {
        // the tick begins with the newest readings
        for (uint8_t k = 0; k < TENDONS; ++k) {
            readings[k] = static_cast<int16_t>(sums[k]);
            sums[k] = 0;
        }
        if (ticks_due < 255) ++ticks_due;
        return;
    }
    ADMUX = static_cast<uint8_t>(_BV(REFS0) | (conversions_left & 3));
    ADCSRA |= _BV(ADSC);
}

ISR(TIMER5_COMPA_vect) {
    if (ticks_due > LATE_TICKS) {
        // the main loop hangs
        PORTA = 0;
        for (uint8_t k = 0; k < TENDONS; ++k) *COMPARE[k] = 0;
    }
    if (conversions_left) return;
    conversions_left = TENDONS * CONVERSIONS;
    ADMUX = _BV(REFS0);
    ADCSRA |= _BV(ADSC);
}

void setup() {
    start_motors();
    pinMode(CONTACT_PIN, INPUT_PULLUP);
    Serial.begin(115200);
    start_converter();
    start_clock();
    set_sleep_mode(SLEEP_MODE_IDLE);
    while (!ticks_due) {
    }
    ticks_due = 0;
    board.start();
}

void loop() {
    while (Serial.available() > 0) board.receive(static_cast<char>(Serial.read()));
    if (ticks_due) {
        int16_t counts[TENDONS];
        cli();
        const uint8_t elapsed = ticks_due;
        ticks_due = 0;
        for (uint8_t k = 0; k < TENDONS; ++k) counts[k] = readings[k];
        sei();
        board.tick(counts, elapsed);
        for (uint8_t k = 0; k < TENDONS; ++k) set_motor(k, board.drive(k));
    }
    port.drain();
    // sleep until the next interrupt; one that came since the questions above ends the sleep at once
    cli();
    if (!ticks_due && Serial.available() == 0) {
        sleep_enable();
        sei();
        sleep_cpu();
        sleep_disable();
    }
    sei();
}
