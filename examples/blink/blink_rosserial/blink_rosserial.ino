// Lesson 1, for rosserial: blink_led lets the lamp on pin 13 blink three times; led says each time how it is now.
#include <MiniRosserial.h>

void blink(const uint8_t *data, uint16_t size);

const mini::Topic topics[] = {
    mini::says("led", mini::STRING),
    mini::hears("blink_led", mini::EMPTY, blink),
};
mini::Node node(Serial, topics);

void lamp(uint8_t level) {
  digitalWrite(13, level);
  node.publish(0, level ? "on" : "off");
}

void blink(const uint8_t *data, uint16_t size) {
  for (uint8_t times = 3; times--;) {
    lamp(HIGH);
    delay(500);
    lamp(LOW);
    delay(500);
  }
}

void setup() {
  pinMode(13, OUTPUT);
  Serial.begin(57600);
}

void loop() { node.spin(); }
