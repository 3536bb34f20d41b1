// Lines of the wire protocol: checksum, numbers, words, and text that is sent.
#pragma once
#include <stdint.h>
#include <string.h>

namespace tension {

const uint16_t CRC_START = 0xFFFF;

// CRC-16/CCITT-FALSE of one more byte.
inline uint16_t crc16(uint16_t crc, uint8_t byte) {
    crc ^= static_cast<uint16_t>(static_cast<uint16_t>(byte) << 8);
    for (uint8_t k = 0; k < 8; ++k)
        crc = (crc & 0x8000u) ? static_cast<uint16_t>((crc << 1) ^ 0x1021u) : static_cast<uint16_t>(crc << 1);
    return crc;
}

inline uint16_t crc16(const char *text, uint8_t length) {
    uint16_t crc = CRC_START;
    for (uint8_t k = 0; k < length; ++k) crc = crc16(crc, static_cast<uint8_t>(text[k]));
    return crc;
}

// Characters of a received line, without its end. A longer line is dropped as a whole.
class LineBuffer {
  public:
    static const uint8_t LONGEST = 63;
    enum Status : uint8_t { PENDING, COMPLETE, TOO_LONG, NOT_TEXT };

    // Takes a byte; COMPLETE when `text` has a line. The next byte begins a new one.
    Status take(char byte) {
        if (done_) clear();
        if (byte == '\n') {
            if (length_ && text[length_ - 1] == '\r') --length_;
            text[length_] = 0;
            done_ = true;
            return bad_ == PENDING ? COMPLETE : bad_;
        }
        if (bad_ != PENDING) return PENDING;
        if ((byte < 0x20 || byte > 0x7E) && byte != '\r') {
            bad_ = NOT_TEXT;
        } else if (length_ == LONGEST) {
            bad_ = TOO_LONG;
        } else {
            text[length_++] = byte;
        }
        return PENDING;
    }

    uint8_t length() const { return length_; }
    char text[LONGEST + 1];

  private:
    void clear() {
        length_ = 0;
        bad_ = PENDING;
        done_ = false;
    }
    uint8_t length_ = 0;
    Status bad_ = PENDING;
    bool done_ = false;
};

// Words of a line, one after the other.
class Words {
  public:
    explicit Words(char *text) : rest_(text) {}

    // Returns the next word, which ends with a zero, or nullptr.
    char *next() {
        while (*rest_ == ' ') ++rest_;
        if (!*rest_) return nullptr;
        char *word = rest_;
        while (*rest_ && *rest_ != ' ') ++rest_;
        if (*rest_) *rest_++ = 0;
        return word;
    }

    // Reads the next word as a whole number from `low` to 65535; false if it is none.
    bool number(int32_t &value) {
        const char *word = next();
        if (!word) return false;
        const bool negative = *word == '-';
        if (negative) ++word;
        // five digits at most, so that nothing overflows
        uint8_t digits = 0;
        int32_t sum = 0;
        for (; *word; ++word, ++digits) {
            if (*word < '0' || *word > '9' || digits == 5) return false;
            sum = 10 * sum + (*word - '0');
        }
        if (!digits) return false;
        value = negative ? -sum : sum;
        return true;
    }

    bool is_empty() {
        while (*rest_ == ' ') ++rest_;
        return !*rest_;
    }

  private:
    char *rest_;
};

// Value of a hexadecimal digit in upper case, or -1.
inline int8_t hex_value(char digit) {
    if (digit >= '0' && digit <= '9') return static_cast<int8_t>(digit - '0');
    if (digit >= 'A' && digit <= 'F') return static_cast<int8_t>(digit - 'A' + 10);
    return -1;
}

// Text of a line that is sent.
class Text {
  public:
    static const uint8_t LONGEST = 120;

    Text &add(char byte) {
        if (length < LONGEST) bytes[length++] = byte;
        return *this;
    }
    Text &add(const char *text) {
        while (*text) add(*text++);
        return *this;
    }
    Text &add(int32_t value) {
        char digits[11];
        uint8_t count = 0;
        uint32_t rest = value < 0 ? 0u - static_cast<uint32_t>(value) : static_cast<uint32_t>(value);
        for (; rest > 0xFFFF; rest /= 10) digits[count++] = static_cast<char>('0' + rest % 10);
        // divisions of 16 bits take a third of the time
        uint16_t small = static_cast<uint16_t>(rest);
        do {
            digits[count++] = static_cast<char>('0' + small % 10);
            small /= 10;
        } while (small);
        if (value < 0) add('-');
        while (count) add(digits[--count]);
        return *this;
    }
    // Adds `*` and the checksum of all before it.
    Text &seal() {
        const uint16_t crc = crc16(bytes, length);
        add('*');
        for (int8_t shift = 12; shift >= 0; shift = static_cast<int8_t>(shift - 4))
            add("0123456789ABCDEF"[(crc >> shift) & 15]);
        return *this;
    }

    char bytes[LONGEST + 1];
    uint8_t length = 0;
};

}  // namespace tension
