// Counts: /add adds its argument and answers the sum, /slow takes a second for it with pin 13 high, /block
// does so and reads nothing meanwhile, /sum answers it.
#include <AiraFrames.h>

#ifndef BAUD
#define BAUD 57600
#endif

void add(aira::Call &call);
void slow(aira::Call &call);
void block(aira::Call &call);
void sum(aira::Call &call);
void values(aira::Call &call);

const aira::Firmware firmware PROGMEM = {"counter", "1.0"};
const aira::Topic topics[] PROGMEM = {
    {"/add", "json", add},
    {"/slow", "json", slow},
    {"/sum", "json", sum},
    {"/values", "json", values},
    {"/added", "json", nullptr},
    {"/block", "json", block},
};
aira::Link mesh(Serial, firmware, topics);
long total;

void add(aira::Call &call) {
  const long number = call.arguments.integer();
  if (!call.arguments.good()) return call.fail(F("that is no integer"));
  total += number;
  call.answer.integer(total);
  aira::Event added(mesh, 4);
  added.integer(number);
  added.send();
}

void slow(aira::Call &call) {
  add(call);
  digitalWrite(13, HIGH);
  mesh.wait(1000);
  digitalWrite(13, LOW);
}

void block(aira::Call &call) {
  add(call);
  delay(1500);
}

void sum(aira::Call &call) { call.answer.integer(total); }

// Takes [integer, real, boolean, text] and answers the same.
void values(aira::Call &call) {
  char text[12];
  aira::Reader &given = call.arguments;
  given.array();
  const long integer = given.integer();
  const float real = given.real();
  const bool boolean = given.boolean();
  given.text(text, sizeof text);
  if (!given.good()) return call.fail(F("[integer, real, boolean, text] is wanted"));
  call.answer.array(4);
  call.answer.integer(integer);
  call.answer.real(real);
  call.answer.boolean(boolean);
  call.answer.text(text);
}

void setup() {
  pinMode(13, OUTPUT);
  Serial.begin(BAUD);
  mesh.begin();
}

void loop() { mesh.poll(); }
