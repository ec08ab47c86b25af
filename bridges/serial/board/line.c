// The serial line of the board: a pseudo-terminal for the host, and a monitor of what the board sends.
#define _GNU_SOURCE
#include "board.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pty.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <termios.h>
#include <unistd.h>

enum {
  BITS = 10,                  // of a byte on the line
  TOLERANCE = 4,              // percent by which the two baud rates may differ
  PAUSE = HERTZ / 1000 * 50,  // cycles of silence that end a line of the monitor
  UCSR0A = 0xC0, UBRR0L = 0xC4, UBRR0H = 0xC5, U2X = 1 << 1,
};

// As the kernel has it; the C library's structure knows no baud rates but those of old.
struct termios2 {
  tcflag_t flags[4];
  cc_t line, characters[19];
  speed_t input, output;
};

static avr_cycle_count_t byte_time(const struct board *board) {
  const uint8_t *data = board->avr->data;
  const unsigned divider = (data[UBRR0H] << 8 | data[UBRR0L]) + 1;
  return (avr_cycle_count_t)BITS * (data[UCSR0A] & U2X ? 8 : 16) * divider;
}

// The terminal has another baud rate than the firmware.
static bool mistuned(const struct board *board) {
  const double own = (double)HERTZ * BITS / byte_time(board);
  return board->speed * 100 < own * (100 - TOLERANCE) || board->speed * 100 > own * (100 + TOLERANCE);
}

static uint8_t damaged(struct board *board, uint8_t byte) { return byte ^ (1 + rand_r(&board->seed) % 255); }

static uint8_t over_the_line(struct board *board, uint8_t byte) {
  const bool noisy = board->noise > 0 && rand_r(&board->seed) < board->noise * ((double)RAND_MAX + 1);
  return noisy ? damaged(board, byte) : byte;
}

// A byte has reached the board; the next one is on the line.
static avr_cycle_count_t arrive(avr_t *avr, avr_cycle_count_t when, void *context) {
  struct board *board = context;
  if (board->begin == board->end) {
    board->sending = false;
    return 0;
  }
  const uint8_t byte = over_the_line(board, board->incoming[board->begin]);
  board->begin = (board->begin + 1) % sizeof board->incoming;
  avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT), byte);
  return when + byte_time(board);
}

static bool has_room(const struct board *board, size_t bytes) {
  const size_t used = (board->end + sizeof board->incoming - board->begin) % sizeof board->incoming;
  return used + bytes < sizeof board->incoming;
}

static void put(struct board *board, uint8_t byte) {
  board->incoming[board->end] = byte;
  board->end = (board->end + 1) % sizeof board->incoming;
  if (board->sending) return;
  board->sending = true;
  avr_cycle_timer_register(board->avr, byte_time(board), arrive, board);
}

// Press the reset button: what is on its way to the board is lost.
void restart(struct board *board) {
  reset(board);
  avr_cycle_timer_cancel(board->avr, arrive, board);
  board->sending = false;
  board->begin = board->end;
}

static void show(struct board *board) {
  if (board->showing) printf("serial %.*s\n", (int)board->showing, board->shown);
  board->showing = 0;
}

// A line of the monitor ends as the board's, when it is long, or after a pause.
static void add_to_monitor(struct board *board, uint8_t byte) {
  char *const end = board->shown + board->showing;
  board->shown_at = board->avr->cycle;
  if (byte == '\n') return show(board);
  if (byte == '\r') return;
  if (byte == '\t') board->showing += sprintf(end, "\\t");
  else if (byte == '\\' || byte < ' ' || byte > '~') board->showing += sprintf(end, "\\x%02x", byte);
  else board->showing += sprintf(end, "%c", byte);
  if (board->showing > sizeof board->shown - 8) show(board);
}

void monitor(struct board *board, bool on) {
  show(board);
  board->monitored = on;
}

void send_text(struct board *board, const char *text) {
  if (!has_room(board, strlen(text) + 1)) return;
  while (*text) put(board, *text++);
  put(board, '\n');
}

static void say(struct avr_irq_t *irq, uint32_t value, void *context) {
  struct board *board = context;
  (void)irq;
  if (board->monitored) add_to_monitor(board, value);
  if (!board->open) return;
  const uint8_t byte = mistuned(board) ? damaged(board, value) : over_the_line(board, value);
  // What the terminal has no room for is lost, as it is where nobody reads a real port.
  if (write(board->terminal, &byte, 1) < 0 && errno != EAGAIN && errno != EIO) perror("write");
}

void watch_line(struct board *board) {
  uint32_t flags = 0;
  avr_ioctl(board->avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
  avr_irq_register_notify(avr_io_getirq(board->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), say, board);
  for (avr_io_t *io = board->avr->io_port; io; io = io->next)
    if (!strcmp(io->kind, "uart")) board->uart = (avr_uart_t *)io;  // an Uno has one
}

int plug(struct board *board) {
  int slave;
  char path[64];
  struct termios raw;
  if (board->terminal >= 0) return 0;
  if (openpty(&board->terminal, &slave, path, NULL, NULL)) return perror("openpty"), 1;
  tcgetattr(slave, &raw);
  cfmakeraw(&raw);
  tcsetattr(slave, TCSANOW, &raw);
  close(slave);
  fcntl(board->terminal, F_SETFL, O_NONBLOCK);
  unlink(board->link);
  if (symlink(path, board->link)) return perror(board->link), 1;
  printf("port %s\n", board->link);
  return 0;
}

void unplug(struct board *board) {
  if (board->terminal < 0) return;
  unlink(board->link);
  close(board->terminal);
  board->terminal = -1;
  board->open = false;
  board->begin = board->end;
  puts("unplugged");
}

// What the last one left unread is not for the next one to read.
static void flush_terminal(struct board *board) {
  const int slave = open(ptsname(board->terminal), O_RDWR | O_NOCTTY | O_NONBLOCK);
  if (slave < 0) return;
  tcflush(slave, TCIOFLUSH);
  close(slave);
}

static void look_at_terminal(struct board *board) {
  struct pollfd terminal = {board->terminal, POLLIN, 0};
  poll(&terminal, 1, 0);
  const bool open = !(terminal.revents & POLLHUP);
  if (open != board->open) {
    board->open = open;
    puts(open ? "opened" : "closed");
    if (open && board->resets) restart(board);
    if (!open) flush_terminal(board);
  }
  struct termios2 settings;
  if (!ioctl(board->terminal, TCGETS2, &settings)) board->speed = settings.output;
  uint8_t bytes[256];
  if (!(terminal.revents & POLLIN) || !has_room(board, sizeof bytes)) return;  // as for a real line, writes wait
  const ssize_t count = read(board->terminal, bytes, sizeof bytes);
  for (ssize_t index = 0; index < count; index++)
    put(board, mistuned(board) ? damaged(board, bytes[index]) : bytes[index]);
}

// To be called often. simavr counts eleven bits a byte, and resets that whenever the firmware sets the baud rate.
void look_at_line(struct board *board) {
  board->uart->cycles_per_byte = byte_time(board);
  if (board->showing && board->avr->cycle - board->shown_at > PAUSE) show(board);
  if (board->terminal >= 0) look_at_terminal(board);
}
