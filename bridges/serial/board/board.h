// What the parts of the simulated board share.
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>

enum {
  HERTZ = 16000000,
  PINS = 20,  // in the order of PORTD, PORTB, PORTC: the Arduino's numbers
};

struct board {
  avr_t *avr;
  const char *link;
  bool resets;             // when the terminal is opened
  avr_uart_t *uart;
  int terminal;            // -1 while unplugged
  bool open;               // somebody has the terminal open
  double speed;            // the baud rate of the terminal
  uint8_t incoming[4096];  // on their way to the board
  size_t begin, end;
  bool sending;            // a byte to the board is on the line
  double noise;            // how many of the bytes are damaged, each way
  unsigned seed;
  bool monitored;          // what the board sends is shown
  char shown[128];         // and has not been shown yet
  size_t showing;
  avr_cycle_count_t shown_at;
  int8_t levels[PINS];
  int dimmed[PINS];        // the duty of pins with PWM, -1 for those without
};

static inline unsigned long long microseconds(const struct board *board) {
  return board->avr->cycle / (HERTZ / 1000000);
}

// line.c
void watch_line(struct board *board);
int plug(struct board *board);
void unplug(struct board *board);
void look_at_line(struct board *board);
void send_text(struct board *board, const char *text);
void monitor(struct board *board, bool on);
void restart(struct board *board);

// pins.c
void watch_pins(struct board *board);
void look_at_pins(struct board *board);
void reset(struct board *board);
bool hold_pin(struct board *board, unsigned pin, const char *level);
