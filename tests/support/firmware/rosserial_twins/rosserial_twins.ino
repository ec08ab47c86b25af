// rosserial: two publishers and two subscribers of one topic each, and a third publisher, which has another type. Each
// subscriber says "first" or "second" through the publisher of its own.
#include <MiniRosserial.h>

void first(const uint8_t *data, uint16_t size);
void second(const uint8_t *data, uint16_t size);

const mini::Topic topics[] = {
    mini::says("said", mini::STRING), mini::says("said", mini::STRING), mini::says("said", mini::EMPTY),
    mini::hears("hear", mini::STRING, first), mini::hears("hear", mini::STRING, second),
};
mini::Node node(Serial, topics);

void first(const uint8_t *data, uint16_t size) { node.publish(0, "first"); }

void second(const uint8_t *data, uint16_t size) { node.publish(1, "second"); }

void setup() { Serial.begin(57600); }

void loop() { node.spin(); }
