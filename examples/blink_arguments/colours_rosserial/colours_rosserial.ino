// Lesson 2, for rosserial: blink_led takes "red" (pin 13) or "blue" (pin 12) and lets that lamp blink three times.
#include <MiniRosserial.h>

void blink(const uint8_t *data, uint16_t size);

const mini::Topic topics[] = {
    mini::says("led", mini::STRING),
    mini::hears("blink_led", mini::STRING, blink),
};
mini::Node node(Serial, topics);

void lamp(uint8_t pin, uint8_t level) {
  digitalWrite(pin, level);
  if (pin == 13) node.publish(0, level ? "red on" : "red off");
  else node.publish(0, level ? "blue on" : "blue off");
}

void blink(const uint8_t *data, uint16_t size) {
  const uint8_t pin = mini::is(data, size, "red") ? 13 : mini::is(data, size, "blue") ? 12 : 0;
  if (!pin) return node.log(mini::WARN, "there is no such lamp");
  for (uint8_t times = 3; times--;) {
    lamp(pin, HIGH);
    delay(500);
    lamp(pin, LOW);
    delay(500);
  }
}

void setup() {
  pinMode(13, OUTPUT);
  pinMode(12, OUTPUT);
  Serial.begin(57600);
}

void loop() { node.spin(); }
