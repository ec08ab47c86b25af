// The board's side of rosserial version 2. It keeps the times of ros_lib: a frame has some 20 ms to come in, the
// time is asked for every 2.5 s, and after 11 s without an answer publishing stops until the host asks for the topics.
//
//   void blink(const uint8_t *data, uint16_t size) { ... }
//   const mini::Topic topics[] = {mini::hears("blink_led", mini::EMPTY, blink), mini::says("state", mini::STRING)};
//   mini::Node node(Serial, topics);
//   void setup() { Serial.begin(57600); }
//   void loop() { node.spin(); }
#pragma once

#include <Arduino.h>

namespace mini {

const uint16_t BUFFER = 280;
// ros_lib says 20 ms and was seen to take 123 bytes at 57600 baud, which are 21.4.
const unsigned long FRAME_MS = 22, SYNC_MS = 2500, LOST_MS = 11000;

enum Special : uint16_t { PUBLISHER = 0, SUBSCRIBER = 1, SERVICE = 2, CLIENT = 4, PARAMETER = 6, LOG = 7, TIME = 10, STOP = 11 };
enum Level : uint8_t { DEBUG, INFO, WARN, ERROR, FATAL };

struct Type {
  const char *name;
  const char *md5;
};
const Type EMPTY = {"std_msgs/Empty", "d41d8cd98f00b204e9800998ecf8427e"};
const Type STRING = {"std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1"};

typedef void (*Handler)(const uint8_t *data, uint16_t size);
// Writes its answer and returns the size of it.
typedef uint16_t (*Service)(const uint8_t *data, uint16_t size, uint8_t *answer);

struct Topic {
  const char *name;
  Type type;
  Handler handler;
  Service service;
  bool asks;
};
inline Topic hears(const char *name, Type type, Handler handler) { return {name, type, handler, nullptr, false}; }
inline Topic says(const char *name, Type type) { return {name, type, nullptr, nullptr, false}; }
inline Topic serves(const char *name, Type type, Service service) { return {name, type, nullptr, service, false}; }
// `publish` asks, and the handler gets the answer, if somebody gives one.
inline Topic asks(const char *name, Type type, Handler answered) { return {name, type, answered, nullptr, true}; }

class Node {
 public:
  template <size_t COUNT>
  Node(Stream &port, const Topic (&topics)[COUNT]) : port_(port), topics_(topics), count_(COUNT) {}

  bool connected() const { return connected_; }

  // Reads what has come and does what was asked; to be called often.
  void spin() {
    const unsigned long now = millis();
    if (now - heard_ > LOST_MS) connected_ = false;
    if (state_ != FIRST && now - begun_ > FRAME_MS) state_ = FIRST;
    while (port_.available()) take(port_.read());
    if (connected_ && now - asked_ > SYNC_MS) askTime();
  }

  // Publishes on the topic with that index in the table.
  void publish(uint8_t index, const uint8_t *data, uint16_t size) {
    if (connected_) send(125 + index, data, size);
  }
  void publish(uint8_t index, const char *text) {
    if (connected_) sendText(125 + index, nullptr, 0, text);
  }
  void log(Level level, const char *text) {
    const uint8_t first = level;
    if (connected_) sendText(LOG, &first, 1, text);
  }
  // Waits a second at most for an integer parameter; `otherwise` if the host has none.
  int32_t parameter(const char *name, int32_t otherwise) {
    parameter_ = otherwise;
    waiting_ = true;
    sendText(PARAMETER, nullptr, 0, name);
    for (const unsigned long begun = millis(); waiting_ && millis() - begun < 1000;) spin();
    return parameter_;
  }

 private:
  enum State : uint8_t { FIRST, SECOND, LOW_SIZE, HIGH_SIZE, SIZE_SUM, LOW_ID, HIGH_ID, DATA, SUM };

  void take(uint8_t byte) {
    sum_ += byte;
    switch (state_) {
      case FIRST:
        if (byte == 0xFF) state_ = SECOND, begun_ = millis();
        return;
      case SECOND:
        state_ = byte == 0xFE ? LOW_SIZE : FIRST;
        return;
      case LOW_SIZE:
        size_ = sum_ = byte;
        break;
      case HIGH_SIZE:
        size_ |= byte << 8;
        break;
      case SIZE_SUM:
        if (sum_ != 0xFF || size_ > BUFFER) return void(state_ = FIRST);
        break;
      case LOW_ID:
        id_ = sum_ = byte;
        break;
      case HIGH_ID:
        id_ |= byte << 8;
        at_ = 0;
        if (!size_) state_ = DATA;  // the sum is next
        break;
      case DATA:
        data_[at_++] = byte;
        if (at_ < size_) return;
        break;
      case SUM:
        state_ = FIRST;
        if (sum_ == 0xFF) obey();
        return;
    }
    state_ = (State)(state_ + 1);
  }

  void obey() {
    const uint8_t index = id_ - 100;
    if (id_ == PUBLISHER) {
      heard_ = millis();
      connected_ = true;
      askTime();
      for (uint8_t each = 0; each < count_; ++each) announce(each);
    } else if (id_ == TIME) {
      heard_ = millis();
    } else if (id_ == STOP) {
      connected_ = false;
    } else if (id_ == PARAMETER) {
      if (size_ >= 8 && data_[0]) memcpy(&parameter_, data_ + 4, 4);
      waiting_ = false;
    } else if (id_ >= 100 && index < count_ && topics_[index].handler) {
      topics_[index].handler(data_, size_);
    } else if (id_ >= 100 && index < count_ && topics_[index].service) {
      uint8_t answer[64];
      const uint16_t size = topics_[index].service(data_, size_, answer);
      send(125 + index, answer, size);
    }
  }

  void askTime() {
    asked_ = millis();
    send(TIME, nullptr, 0);
  }

  void announce(uint8_t index) {
    const Topic &topic = topics_[index];
    if (topic.asks) {
      announce(CLIENT + PUBLISHER, 125 + index, topic);
      announce(CLIENT + SUBSCRIBER, 100 + index, topic);
    } else if (topic.service) {
      announce(SERVICE + PUBLISHER, 125 + index, topic);
      announce(SERVICE + SUBSCRIBER, 100 + index, topic);
    } else if (topic.handler) {
      announce(SUBSCRIBER, 100 + index, topic);
    } else {
      announce(PUBLISHER, 125 + index, topic);
    }
  }

  void announce(uint16_t kind, uint16_t id, const Topic &topic) {
    begin(kind, 2 + 4 + strlen(topic.name) + 4 + strlen(topic.type.name) + 4 + strlen(topic.type.md5) + 4);
    put(id);
    put(id >> 8);
    putText(topic.name);
    putText(topic.type.name);
    putText(topic.type.md5);
    putSize(BUFFER);
    end();
  }

  void send(uint16_t id, const uint8_t *data, uint16_t size) {
    begin(id, size);
    while (size--) put(*data++);
    end();
  }

  void sendText(uint16_t id, const uint8_t *before, uint8_t count, const char *text) {
    begin(id, count + 4 + strlen(text));
    while (count--) put(*before++);
    putText(text);
    end();
  }

  void begin(uint16_t id, uint16_t size) {
    const uint8_t head[] = {0xFF, 0xFE, (uint8_t)size, (uint8_t)(size >> 8), (uint8_t)(255 - (size & 0xFF) - (size >> 8))};
    port_.write(head, sizeof head);
    sent_ = 0;
    put(id);
    put(id >> 8);
  }
  void put(uint8_t byte) {
    sent_ += byte;
    port_.write(byte);
  }
  void putSize(uint32_t size) {
    for (uint8_t count = 4; count--; size >>= 8) put(size);
  }
  void putText(const char *text) {
    putSize(strlen(text));
    while (*text) put(*text++);
  }
  void end() { port_.write((uint8_t)(255 - sent_)); }

  Stream &port_;
  const Topic *topics_;
  uint8_t count_;
  bool connected_ = false, waiting_ = false;
  State state_ = FIRST;
  uint8_t sum_ = 0, sent_ = 0;
  uint16_t size_ = 0, at_ = 0, id_ = 0;
  int32_t parameter_ = 0;
  unsigned long begun_ = 0, heard_ = 0, asked_ = 0;
  uint8_t data_[BUFFER];
};

// Whether a std_msgs/String holds this text.
inline bool is(const uint8_t *data, uint16_t size, const char *text) {
  return size == 4 + strlen(text) && data[0] == size - 4 && !memcmp(data + 4, text, size - 4);
}

}  // namespace mini
