// The pins of the board: which levels the firmware gives them, how far it dims them, and what holds them from outside.
#include "board.h"

#include <stdio.h>
#include <string.h>

#include <simavr/avr_ioport.h>

// A timer, by the addresses of its registers, and the pins that it can dim.
static const struct timer {
  uint16_t control_a, control_b, capture;  // a timer without `capture` counts to 255
  struct output {
    uint8_t pin, shift;  // of its mode in `control_a`
    uint16_t compare;
  } outputs[2];
} TIMERS[] = {
    {0x44, 0x45, 0, {{6, 6, 0x47}, {5, 4, 0x48}}},
    {0x80, 0x81, 0x86, {{9, 6, 0x88}, {10, 4, 0x8A}}},
    {0xB0, 0xB1, 0, {{11, 6, 0xB3}, {3, 4, 0xB4}}},
};
static const int8_t NONE = -1;
static avr_ioport_external_t held[3];  // of the ports B, C and D, from outside

static char port_of(unsigned pin) { return pin < 8 ? 'D' : pin < 14 ? 'B' : 'C'; }
static unsigned bit_of(unsigned pin) { return pin < 8 ? pin : pin < 14 ? pin - 8 : pin - 14; }

static unsigned word(const struct board *board, uint16_t address) {
  return board->avr->data[address] | board->avr->data[address + 1] << 8;
}

// What a timer counts to for PWM, 0 in its other modes.
static unsigned top_of(const struct board *board, const struct timer *timer) {
  const uint8_t *data = board->avr->data;
  const unsigned low = data[timer->control_a] & 3, high = data[timer->control_b] >> 3 & 3;
  if (!(data[timer->control_b] & 7)) return 0;  // it stands still
  if (!timer->capture) return !(low & 1) ? 0 : high & 1 ? data[timer->outputs[0].compare] : 255;
  switch (high << 2 | low) {
    case 1: case 5: return 0xFF;
    case 2: case 6: return 0x1FF;
    case 3: case 7: return 0x3FF;
    case 8: case 10: case 14: return word(board, timer->capture);
    case 9: case 11: case 15: return word(board, timer->outputs[0].compare);
  }
  return 0;
}

// How far a pin is dimmed, -1 for not at all.
static int duty_of(const struct board *board, unsigned pin, unsigned *top) {
  const uint8_t *data = board->avr->data;
  for (const struct timer *timer = TIMERS; timer < TIMERS + 3; timer++)
    for (const struct output *output = timer->outputs; output < timer->outputs + 2; output++) {
      if (output->pin != pin) continue;
      const unsigned mode = data[timer->control_a] >> output->shift & 3;
      *top = top_of(board, timer);
      if (mode < 2 || !*top) return NONE;
      unsigned value = timer->capture ? word(board, output->compare) : data[output->compare];
      if (value > *top) value = *top;
      return mode == 3 ? *top - value : value;
    }
  return NONE;
}

static void change(struct board *board, int pin, uint32_t level) {
  unsigned top;
  if (pin >= PINS || board->levels[pin] == (int8_t)level) return;
  if (board->dimmed[pin] != NONE || duty_of(board, pin, &top) != NONE) return;
  board->levels[pin] = level;
  printf("pin %d %u %llu\n", pin, level, microseconds(board));
}

#define PORT(name, first)                                                               \
  static void change_##name(struct avr_irq_t *irq, uint32_t value, void *context) {     \
    change(context, (first) + (int)irq->irq, value & 1);                                \
  }
PORT(d, 0)
PORT(b, 8)
PORT(c, 14)

static void watch(struct board *board, char port, int pins, avr_irq_notify_t notify) {
  for (int pin = 0; pin < pins; pin++)
    avr_irq_register_notify(avr_io_getirq(board->avr, AVR_IOCTL_IOPORT_GETIRQ(port), pin), notify, board);
}

void watch_pins(struct board *board) {
  for (int pin = 0; pin < PINS; pin++) board->dimmed[pin] = NONE;
  watch(board, 'D', 8, change_d);
  watch(board, 'B', 6, change_b);
  watch(board, 'C', 6, change_c);
}

// To be called often: a dimmed pin changes its level a thousand times a second, and is reported when its duty changes.
void look_at_pins(struct board *board) {
  unsigned top = 0;
  for (unsigned pin = 0; pin < PINS; pin++) {
    const int duty = duty_of(board, pin, &top);
    if (duty == board->dimmed[pin]) continue;
    board->dimmed[pin] = duty;
    if (duty != NONE) {
      printf("pwm %u %d %u %llu\n", pin, duty, top, microseconds(board));
    } else {
      avr_ioport_state_t state;
      avr_ioctl(board->avr, AVR_IOCTL_IOPORT_GETSTATE(port_of(pin)), &state);
      board->levels[pin] = NONE;
      change(board, pin, state.port >> bit_of(pin) & 1);
    }
  }
}

// Hold an input "high" or "low", or let it be "free"; false for another level, or no such pin.
bool hold_pin(struct board *board, unsigned pin, const char *level) {
  const bool high = !strcmp(level, "high"), released = !strcmp(level, "free");
  if (pin >= PINS || !(high || released || !strcmp(level, "low"))) return false;
  const unsigned bit = bit_of(pin), mask = 1 << bit;
  avr_ioport_external_t *port = &held[port_of(pin) - 'B'];
  avr_ioport_state_t state;
  port->name = port_of(pin);
  port->mask = released ? port->mask & ~mask : port->mask | mask;
  port->value = high ? port->value | mask : port->value & ~mask;
  avr_ioctl(board->avr, AVR_IOCTL_IOPORT_SET_EXTERNAL(port->name), port);
  avr_ioctl(board->avr, AVR_IOCTL_IOPORT_GETSTATE(port->name), &state);
  if (state.ddr & mask) return true;  // an output: the firmware decides
  const unsigned now = released ? state.port >> bit & 1 : high;  // a free one follows its pull-up
  avr_raise_irq(avr_io_getirq(board->avr, AVR_IOCTL_IOPORT_GETIRQ(port->name), bit), now);
  return true;
}

// Reset the chip. simavr then forgets the levels of inputs, but not that it has reported them: so they are
// reported again.
void reset(struct board *board) {
  avr_ioport_state_t before[3];
  for (int port = 0; port < 3; port++) avr_ioctl(board->avr, AVR_IOCTL_IOPORT_GETSTATE('B' + port), &before[port]);
  avr_reset(board->avr);
  for (unsigned pin = 0; pin < PINS; pin++) {
    const char name = port_of(pin);
    const unsigned bit = bit_of(pin);
    const avr_ioport_external_t *port = &held[name - 'B'];
    avr_irq_t *irq = avr_io_getirq(board->avr, AVR_IOCTL_IOPORT_GETIRQ(name), bit);
    if (before[name - 'B'].ddr >> bit & 1) avr_raise_irq(irq, 0);  // no output any more
    irq->value = 0;
    if (port->mask >> bit & 1) avr_raise_irq(irq, port->value >> bit & 1);
  }
}
