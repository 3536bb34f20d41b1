// The ATmega2560 in simavr, advanced by exact numbers of cycles: converter inputs in, registers and serial bytes out.
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include <simavr/avr_adc.h>
#include <simavr/avr_eeprom.h>
#include <simavr/avr_extint.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_hex.h>

#define QUEUE 65536
#define CHANNELS 4

typedef struct {
    avr_t *avr;
    avr_irq_t *to_chip, *contact, *analog[CHANNELS];
    uint8_t out[QUEUE], in[QUEUE];
    uint32_t out_head, out_tail, in_head, in_tail;
    uint64_t next_byte;
    uint32_t millivolts[CHANNELS];
    int failed, open;
} Emulator;

// The byte time of 115200 baud (10 bits), in cycles of 16 MHz.
static const uint64_t BYTE_CYCLES = 1389;

static void on_byte(struct avr_irq_t *irq, uint32_t value, void *parameter) {
    (void)irq;
    Emulator *self = parameter;
    if (self->out_head - self->out_tail < QUEUE) self->out[self->out_head++ % QUEUE] = (uint8_t)value;
}

// Gives the converter its input when a conversion begins.
static void on_conversion(struct avr_irq_t *irq, uint32_t value, void *parameter) {
    (void)irq;
    (void)value;
    Emulator *self = parameter;
    for (int k = 0; k < CHANNELS; ++k)
        avr_raise_irq(self->analog[k], self->millivolts[k]);
}

// A sleeping chip skips to its next event; simavr would sleep as well, to keep real time.
static void on_sleep(avr_t *avr, avr_cycle_count_t cycles) {
    (void)avr;
    (void)cycles;
}

// simavr polls the pins of external interrupts, which the program does not use, in every cycle while they are low.
// A reset starts this again.
static void stop_polling(avr_t *avr) {
    for (int k = 0; k < 8; ++k) avr_extint_set_strict_lvl_trig(avr, (uint8_t)k, 0);
}

// Drives pin 18 (port D, bit 3): a closed contact pulls it down, an open one leaves it to the chip's pull-up.
static void drive_contact(Emulator *self) {
    avr_ioport_external_t external = {.name = 'D', .mask = self->open ? 0 : 1u << 3, .value = 0};
    avr_ioctl(self->avr, AVR_IOCTL_IOPORT_SET_EXTERNAL('D'), &external);
    avr_ioport_state_t state;
    memset(&state, 0, sizeof state);
    avr_ioctl(self->avr, AVR_IOCTL_IOPORT_GETSTATE('D'), &state);
    avr_raise_irq(self->contact, self->open ? (state.port >> 3) & 1 : 0);
}

static void on_log(avr_t *avr, const int level, const char *format, va_list arguments) {
    (void)avr;
    (void)level;
    (void)format;
    (void)arguments;
}

Emulator *emulator_open(const char *elf) {
    avr_global_logger_set(on_log);
    elf_firmware_t firmware;
    memset(&firmware, 0, sizeof firmware);
    if (elf_read_firmware(elf, &firmware) != 0) return NULL;
    Emulator *self = calloc(1, sizeof *self);
    self->avr = avr_make_mcu_by_name("atmega2560");
    if (!self->avr) return free(self), NULL;
    avr_init(self->avr);
    self->avr->log = LOG_NONE;
    firmware.frequency = 16000000;
    avr_load_firmware(self->avr, &firmware);
    self->avr->frequency = 16000000;
    self->avr->sleep = on_sleep;
    self->avr->vcc = self->avr->avcc = self->avr->aref = 5000;
    stop_polling(self->avr);
    uint32_t flags = 0;
    avr_ioctl(self->avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    // no echo on this process's output, and no sleep of the emulator while the chip polls
    flags &= ~(uint32_t)(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP);
    avr_ioctl(self->avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_register_notify(avr_io_getirq(self->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_byte, self);
    avr_irq_register_notify(avr_io_getirq(self->avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_OUT_TRIGGER), on_conversion, self);
    for (int k = 0; k < CHANNELS; ++k)
        self->analog[k] = avr_io_getirq(self->avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0 + k);
    self->to_chip = avr_io_getirq(self->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    self->contact = avr_io_getirq(self->avr, AVR_IOCTL_IOPORT_GETIRQ('D'), IOPORT_IRQ_PIN3);
    drive_contact(self);
    return self;
}

// Runs up to a count of cycles since the start. Returns 0, or 1 if the program has crashed.
int emulator_run(Emulator *self, uint64_t cycles, const uint32_t *millivolts) {
    memcpy(self->millivolts, millivolts, sizeof self->millivolts);
    avr_t *avr = self->avr;
    while (avr->cycle < cycles && !self->failed) {
        if (self->in_tail != self->in_head && avr->cycle >= self->next_byte) {
            avr_raise_irq(self->to_chip, self->in[self->in_tail++ % QUEUE]);
            self->next_byte = avr->cycle + BYTE_CYCLES;
        }
        const int state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed) self->failed = 1;
    }
    return self->failed;
}

uint64_t emulator_cycle(const Emulator *self) { return self->avr->cycle; }

// Sends bytes to the chip, at 115200 baud. Returns the number that fitted.
uint32_t emulator_send(Emulator *self, const uint8_t *bytes, uint32_t count) {
    uint32_t taken = 0;
    while (taken < count && self->in_head - self->in_tail < QUEUE) self->in[self->in_head++ % QUEUE] = bytes[taken++];
    return taken;
}

// Takes bytes that the chip has sent.
uint32_t emulator_receive(Emulator *self, uint8_t *bytes, uint32_t size) {
    uint32_t count = 0;
    while (count < size && self->out_tail != self->out_head) bytes[count++] = self->out[self->out_tail++ % QUEUE];
    return count;
}

// Opens or closes the contact of the emergency stop.
void emulator_contact(Emulator *self, int open) {
    self->open = open;
    drive_contact(self);
}

uint8_t emulator_register(const Emulator *self, uint16_t address) { return self->avr->data[address]; }

// Reads (`write` 0) or writes EEPROM.
void emulator_eeprom(Emulator *self, uint8_t *bytes, uint16_t count, int write) {
    avr_eeprom_desc_t desc = {.ee = bytes, .offset = 0, .size = count};
    avr_ioctl(self->avr, write ? AVR_IOCTL_EEPROM_SET : AVR_IOCTL_EEPROM_GET, &desc);
}

// Resets the chip, as opening the port or a brown-out does; EEPROM is kept.
void emulator_reset(Emulator *self) {
    const uint64_t cycle = self->avr->cycle;
    avr_reset(self->avr);
    stop_polling(self->avr);
    self->avr->cycle = cycle;
    drive_contact(self);
    self->in_tail = self->in_head;
    self->out_tail = self->out_head;
}

void emulator_close(Emulator *self) {
    if (!self) return;
    avr_terminate(self->avr);
    free(self);
}
