// The board's side of AIRA's own frames; docs/reference/frames.md of aira-mesh has them to the byte.
//
//   void echo(aira::Call &call) { call.answer.raw(call.arguments.data(), call.arguments.size()); }
//
//   const aira::Firmware firmware PROGMEM = {"echo", "1.0"};
//   const aira::Topic topics[] PROGMEM = {{"/echo", "json", echo}, {"/measurements", "std_msgs/String", nullptr}};
//   aira::Link mesh(Serial, firmware, topics);
//
//   void setup() { Serial.begin(57600); mesh.begin(); }
//   void loop() { mesh.poll(); }
#pragma once

#include <Arduino.h>
#include <util/crc16.h>

namespace aira {

const uint8_t LONGEST = 96;    // bytes of payload
const uint8_t BOARD_ID = 0xFF; // what concerns the board as a whole

enum Kind : uint8_t {
  ASK = 1, OPEN = 2, CALL = 3,
  BOARD = 8, TOPIC = 9, OPENED = 10, TAKEN = 11, DONE = 12, FAILED = 13, EVENT = 14
};

// Reads the msgpack values of a payload, one after the other. What is not there, or of another type, reads as zero,
// and `good()` says so.
class Reader {
 public:
  Reader(const uint8_t *data, uint8_t size) : at_(data), left_(size), good_(true) {}
  bool good() const { return good_; }
  const uint8_t *data() const { return at_; }
  uint8_t size() const { return left_; }

  long integer() {
    const uint8_t code = byte();
    if (code < 0x80) return code;
    if (code >= 0xE0) return (int8_t)code;
    switch (code) {
      case 0xCC: return byte();
      case 0xCD: return bytes(2);
      case 0xCE: case 0xD2: return bytes(4);
      case 0xD0: return (int8_t)byte();
      case 0xD1: return (int16_t)bytes(2);
    }
    return bad();
  }

  bool boolean() {
    const uint8_t code = byte();
    if ((code & 0xFE) != 0xC2) bad();
    return code == 0xC3;
  }

  // A number, also one that was sent as an integer. A double keeps what an Uno's four bytes can hold.
  float real() {
    if (!left_ || (*at_ != 0xCA && *at_ != 0xCB)) return integer();
    uint32_t bits;
    if (byte() == 0xCA) {
      bits = bytes(4);
    } else {
      const uint32_t high = bytes(4), low = bytes(4);
      const int exponent = (int)((high >> 20) & 0x7FF) - 1023 + 127;
      bits = (high & 0x80000000UL) | ((high & 0xFFFFFUL) << 3) | (low >> 29);
      if (exponent >= 255) bits = (high & 0x80000000UL) | 0x7F800000UL;
      else if (exponent <= 0) bits = 0;
      else bits |= (uint32_t)exponent << 23;
    }
    float number;
    memcpy(&number, &bits, sizeof number);
    return number;
  }

  // Whether the next value is this text, which stands in flash: call.arguments.is(F("red")).
  bool is(const __FlashStringHelper *text) {
    const char *expected = reinterpret_cast<const char *>(text);
    Reader probe = *this;
    const uint8_t size = probe.opened();
    if (!probe.good_ || size != strlen_P(expected) || memcmp_P(probe.at_, expected, size)) return false;
    probe.skip(size);
    *this = probe;
    return true;
  }

  // Copies a text and ends it with a zero; false if there is none or `room` is too small.
  bool text(char *into, uint8_t room) {
    const uint8_t size = opened();
    if (!good_ || size >= room) return bad();
    memcpy(into, at_, size);
    into[size] = 0;
    skip(size);
    return true;
  }

  // How many values an array has; they are read next.
  uint8_t array() {
    const uint8_t code = byte();
    return (code & 0xF0) == 0x90 ? code & 0x0F : bad();
  }

 private:
  uint8_t byte() {
    if (!left_) return bad();
    --left_;
    return *at_++;
  }
  uint32_t bytes(uint8_t count) {
    uint32_t value = 0;
    while (count--) value = value << 8 | byte();
    return value;
  }
  uint8_t opened() {
    const uint8_t code = byte();
    const uint8_t size = (code & 0xE0) == 0xA0 ? code & 0x1F : code == 0xD9 ? byte() : bad();
    return size <= left_ ? size : bad();
  }
  void skip(uint8_t size) {
    at_ += size;
    left_ -= size;
  }
  uint8_t bad() {
    good_ = false;
    left_ = 0;
    return 0;
  }

  const uint8_t *at_;
  uint8_t left_;
  bool good_;
};

// Writes msgpack values, one after the other. What finds no room is left out whole.
class Writer {
 public:
  explicit Writer(uint8_t *data) : data_(data), size_(0) {}
  uint8_t size() const { return size_; }

  void integer(long value) {
    if (value >= -32 && value < 128) byte((uint8_t)value);
    else word(0xD2, value);
  }
  void boolean(bool value) { byte(value ? 0xC3 : 0xC2); }
  void nothing() { byte(0xC0); }
  void array(uint8_t values) { byte(0x90 | values); }  // at most 15, which are written next
  void real(float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    word(0xCA, bits);
  }
  void text(const char *value) {
    const uint8_t size = strlen(value);
    if (open(size)) raw(reinterpret_cast<const uint8_t *>(value), size);
  }
  void text(const __FlashStringHelper *value) { flashText(reinterpret_cast<const char *>(value)); }
  void flashText(const char *value) {
    const uint8_t size = strlen_P(value);
    if (!open(size)) return;
    memcpy_P(data_ + size_, value, size);
    size_ += size;
  }
  void raw(const uint8_t *value, uint8_t size) {
    if (size_ + size > LONGEST) return;
    memcpy(data_ + size_, value, size);
    size_ += size;
  }
  void clear() { size_ = 0; }

 private:
  friend class Link;
  void byte(uint8_t value) {
    if (size_ < LONGEST) data_[size_++] = value;
  }
  void word(uint8_t code, uint32_t value) {
    if (size_ + 5 > LONGEST) return;
    byte(code);
    for (uint8_t count = 4; count--; value <<= 8) byte(value >> 24);
  }
  bool open(uint8_t size) {
    if (size_ + 2 + size > LONGEST) return false;
    if (size < 32) {
      byte(0xA0 | size);
    } else {
      byte(0xD9);
      byte(size);
    }
    return true;
  }

  uint8_t *data_;
  uint8_t size_;
};

// One call: what it was given, and what it answers (nothing, if nothing is written).
struct Call {
  Reader arguments;
  Writer answer;
  bool failed;

  // It has not been done, and this is why.
  void fail(const __FlashStringHelper *why) {
    failed = true;
    answer.clear();
    answer.text(why);
  }
};

// A topic: with a handler it can be called, without one the board publishes it. The type is "std_msgs/Empty",
// "std_msgs/String", "json" (any msgpack value) or "raw" (bytes as they are).
struct Topic {
  char name[24];
  char type[16];
  void (*handler)(Call &);
};

struct Firmware {
  char name[24];
  char version[12];
};

class Link {
 public:
  // `firmware` and `topics` stand in flash (PROGMEM).
  template <size_t COUNT>
  Link(Stream &port, const Firmware &firmware, const Topic (&topics)[COUNT])
      : port_(port), firmware_(firmware), topics_(topics), count_(COUNT) {}

  // Says that the board is there; after the port's own begin().
  void begin() { introduce(0); }

  // Reads what has come and does what was asked; to be called often: within 10 ms the port's 64 bytes are full.
  void poll() {
    while (port_.available()) {
      const uint8_t byte = port_.read();
      if (byte) {
        take(byte);
      } else {
        const uint8_t size = size_;
        const bool whole = !first_ && !left_ && size >= 4 && size <= sizeof frame_;
        reset();
        if (whole && !checksum(frame_, size - 2, frame_[size - 2] | frame_[size - 1] << 8)) obey(size - 4);
      }
    }
  }

  // In a handler, instead of delay(): when the host asks again, it gets the answer that the call is still being done.
  void wait(unsigned long milliseconds) {
    const unsigned long begun = millis();
    do {
      while (port_.available()) {
        if (port_.read()) {
          asked_ = true;
        } else if (asked_) {
          asked_ = false;
          uint8_t frame[4] = {(uint8_t)(TAKEN << 4 | last_), answer_[1]};
          send(frame, 0);
        }
      }
    } while (millis() - begun < milliseconds);
  }

 private:
  friend class Event;
  static const uint8_t NONE = 0xFF;

  void take(uint8_t byte) {
    if (left_) {
      --left_;
    } else {
      left_ = byte - 1;
      byte = 0;
      if (first_) {
        first_ = false;
        return;
      }
    }
    if (size_ < sizeof frame_) frame_[size_] = byte;
    if (size_ < 255) ++size_;
  }

  void reset() {
    size_ = left_ = 0;
    first_ = true;
  }

  void obey(uint8_t size) {
    const uint8_t kind = frame_[0] >> 4, sequence = frame_[0] & 0x0F, id = frame_[1];
    if (kind == CALL && session_) {
      if (sequence != last_) perform(sequence, id, size);
      send(answer_, answered_);
    } else if (kind == OPEN && size == 2) {
      session_ = frame_[2] | frame_[3] << 8;
      last_ = NONE;
      reply(OPENED, sequence, id, 0);
    } else if (kind == ASK && id < count_) {
      describe(sequence, id);
    } else if (kind < BOARD) {
      introduce(sequence);
    }
  }

  void perform(uint8_t sequence, uint8_t id, uint8_t size) {
    Call call = {Reader(frame_ + 2, size), Writer(answer_ + 2), false};
    void (*handler)(Call &) = nullptr;
    if (id < count_) handler = (void (*)(Call &))pgm_read_ptr(&topics_[id].handler);
    last_ = sequence;
    answer_[1] = id;
    asked_ = false;
    if (handler) handler(call);
    else call.failed = true;  // there is no such call
    answer_[0] = (call.failed ? FAILED : DONE) << 4 | sequence;
    answered_ = call.answer.size();
  }

  // These answers are made where the question stood: the answer of the last call is kept.
  void introduce(uint8_t sequence) {
    Writer words(frame_ + 2);
    words.array(5);
    words.byte(1);  // the protocol's version
    words.flashText(firmware_.name);
    words.flashText(firmware_.version);
    words.byte(0xCD);
    words.byte(session_ >> 8);
    words.byte(session_);
    words.byte(count_);
    reply(BOARD, sequence, BOARD_ID, words.size());
  }

  void describe(uint8_t sequence, uint8_t id) {
    Writer words(frame_ + 2);
    words.array(3);
    words.boolean(pgm_read_ptr(&topics_[id].handler));
    words.flashText(topics_[id].name);
    words.flashText(topics_[id].type);
    reply(TOPIC, sequence, id, words.size());
  }

  void reply(uint8_t kind, uint8_t sequence, uint8_t id, uint8_t size) {
    frame_[0] = kind << 4 | sequence;
    frame_[1] = id;
    send(frame_, size);
  }

  static uint16_t checksum(const uint8_t *data, uint8_t size, uint16_t expected) {
    uint16_t sum = 0xFFFF;
    while (size--) sum = _crc_xmodem_update(sum, *data++);
    return sum ^ expected;
  }

  // Sends a frame with `size` bytes of payload; two bytes behind it are free for the check. The zero before it ends what
  // the sketch has printed.
  void send(uint8_t *frame, uint8_t size) {
    const uint16_t sum = checksum(frame, size + 2, 0);
    frame[size + 2] = sum;
    frame[size + 3] = sum >> 8;
    const uint8_t *const end = frame + size + 4;
    port_.write((uint8_t)0);
    for (const uint8_t *zero = frame;; frame = (uint8_t *)++zero) {
      while (zero < end && *zero) ++zero;
      port_.write((uint8_t)(zero - frame + 1));
      while (frame < zero) port_.write(*frame++);
      if (zero == end) break;
    }
    port_.write((uint8_t)0);
  }

  Stream &port_;
  const Firmware &firmware_;
  const Topic *const topics_;
  const uint8_t count_;
  uint16_t session_ = 0;
  uint8_t last_ = NONE;
  uint8_t events_ = 0;
  uint8_t answered_ = 0;
  uint8_t size_ = 0;
  uint8_t left_ = 0;
  bool first_ = true;
  bool asked_ = false;
  uint8_t frame_[LONGEST + 4];
  uint8_t answer_[LONGEST + 4];
};

// Something that the board says by itself: write values, then send(). Takes 100 bytes of stack; may be lost on the way.
class Event : public Writer {
 public:
  Event(Link &link, uint8_t topic) : Writer(frame_ + 2), link_(link) { frame_[1] = topic; }
  void send() {
    link_.events_ = (link_.events_ + 1) & 0x0F;
    frame_[0] = EVENT << 4 | link_.events_;
    link_.send(frame_, size());
  }

 private:
  Link &link_;
  uint8_t frame_[LONGEST + 4];
};

}  // namespace aira
