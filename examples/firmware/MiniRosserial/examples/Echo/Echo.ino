// rosserial: says on `said` what it hears on `hear`.
#include <MiniRosserial.h>

#ifndef BAUD
#define BAUD 57600
#endif

void hear(const uint8_t *data, uint16_t size);

const mini::Topic topics[] = {mini::says("said", mini::STRING), mini::hears("hear", mini::STRING, hear)};
mini::Node node(Serial, topics);

void hear(const uint8_t *data, uint16_t size) { node.publish(0, data, size); }

void setup() { Serial.begin(BAUD); }

void loop() { node.spin(); }
