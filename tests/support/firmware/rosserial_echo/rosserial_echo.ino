// rosserial: says on `said` what it hears on `hear`; `loud` is a parameter, `twice` a service, `work` takes twice WORK;
// `inquire` asks `weather` and says the answer, `garble` sends what a host can't know and a log that is no text.
#include <MiniRosserial.h>

#ifndef WORK
#define WORK 150
#endif
#ifndef BAUD
#define BAUD 57600
#endif

void hear(const uint8_t *data, uint16_t size);
void work(const uint8_t *data, uint16_t size);
uint16_t twice(const uint8_t *data, uint16_t size, uint8_t *answer);
void ask(const uint8_t *data, uint16_t size);
void inquire(const uint8_t *data, uint16_t size);
void garble(const uint8_t *data, uint16_t size);

const mini::Topic topics[] = {
    mini::says("said", mini::STRING),
    mini::hears("hear", mini::STRING, hear),
    mini::hears("work", mini::EMPTY, work),
    mini::hears("ask", mini::EMPTY, ask),
    mini::serves("twice", {"std_srvs/Empty", "d41d8cd98f00b204e9800998ecf8427e"}, twice),
    mini::asks("weather", {"rosserial_arduino/Test", "0825d95fdfa2c8f4bbb4e9c74bccd3fd"}, hear),
    mini::hears("inquire", mini::EMPTY, inquire),
    mini::hears("garble", mini::EMPTY, garble),
};
mini::Node node(Serial, topics);

void hear(const uint8_t *data, uint16_t size) { node.publish(0, data, size); }

void work(const uint8_t *data, uint16_t size) {
  digitalWrite(13, HIGH);
  delay(WORK);
  digitalWrite(13, LOW);
  delay(WORK);
}

uint16_t twice(const uint8_t *data, uint16_t size, uint8_t *answer) {
  digitalWrite(12, HIGH);
  digitalWrite(12, LOW);
  return 0;
}

void ask(const uint8_t *data, uint16_t size) {
  node.publish(0, node.parameter("~loud", 0) == 7 ? "loud" : "quiet");
  node.log(mini::WARN, "asked");
}

void inquire(const uint8_t *data, uint16_t size) { node.publish(5, "how is it?"); }

void garble(const uint8_t *data, uint16_t size) {
  node.publish(90, "nobody knows this id");
  node.log(mini::ERROR, "\xC3(hot\xFF");
}

void setup() {
  pinMode(13, OUTPUT);
  pinMode(12, OUTPUT);
  Serial.begin(BAUD);
}

void loop() { node.spin(); }
