// A trigger controller for boards with an ATmega328P at 16 MHz (Arduino Uno, Nano), by ../TRIGGER.md.
//
// Pin 9 (OC1A) carries the pulses, to projector and camera alike. Timer 1 sets and clears the pin by itself, so edges are
// exact to its step whatever the program is doing; the program only counts, tells, and loads the next edge in good time.
//
// Timer 1 runs through 65536 steps of 0.5 us (prescaler 8). An edge further away than that is waited for in rounds: the
// compare unit is told to leave the pin alone until the last one.

#include <avr/interrupt.h>
#include <util/atomic.h>

static const uint8_t PULSE_PIN = 9;
static const char MODEL[] = "atmega328p";
static const char SERIAL_NUMBER[] = "1";  // Give every board its own.

static const uint32_t STEP_NANOS = 500;
static const uint32_t MIN_PERIOD_STEPS = 500;  // 250 us: below that the interrupts would overlap.
static const uint64_t MAX_PERIOD_NANOS = 10000000000ULL;
static const uint64_t MIN_WIDTH_NANOS = 1000;
static const uint32_t MIN_WIDTH_STEPS = 80;     // 40 us: time for the interrupt that loads the falling edge.
static const uint32_t FIRE_DELAY_STEPS = 2000;  // 1 ms: time for the reply to go out first.
static const uint8_t MAX_LINE = 120;
static const uint8_t QUEUE = 16;

enum State : uint8_t { IDLE, ARMED, FIRING };
enum EventKind : uint8_t { PULSE, DONE, OVERRUN };
struct Event {
  EventKind kind;
  uint32_t counter;
  uint64_t steps;
};

// Shared with the interrupts.
static volatile uint32_t clock_high = 0;  // Rounds of timer 1.
static volatile State state = IDLE;
static volatile uint32_t fired = 0;
static volatile uint32_t lost = 0;
static volatile bool is_high = false;   // The pin, after the edge that is waited for last.
static uint64_t edge_steps = 0;         // When the next edge is due.
static uint64_t rise_steps = 0;         // When the last pulse began.
static uint32_t left = 0;               // Pulses still to fire; 0 goes on for ever.
static uint64_t period_steps = 0, width_steps = 0;
static uint32_t report_every = 1;
static Event queue[QUEUE];
static volatile uint8_t queue_head = 0, queue_tail = 0;

// ---- The clock and the edges ---------------------------------------------------------------------------------------------

ISR(TIMER1_OVF_vect) { clock_high++; }

// To be called with interrupts off.
static uint64_t now_steps() {
  uint16_t low = TCNT1;
  uint32_t high = clock_high;
  // A round that has ended while interrupts were off is not counted yet.
  if ((TIFR1 & _BV(TOV1)) && low < 0x8000) high++;
  return ((uint64_t)high << 16) | low;
}

static void push(EventKind kind, uint32_t counter, uint64_t steps) {
  uint8_t next = (queue_head + 1) % QUEUE;
  if (next == queue_tail) {
    lost++;
    return;
  }
  queue[queue_head] = {kind, counter, steps};
  queue_head = next;
}

// Loads the edge that is due next. What the pin does at the compare: COM1A 3 sets, 2 clears, 0 leaves it alone.
static void load_edge() {
  uint8_t mode = TCCR1A & ~(_BV(COM1A1) | _BV(COM1A0));
  OCR1A = (uint16_t)edge_steps;
  if (edge_steps - now_steps() < 0x10000) mode |= is_high ? _BV(COM1A1) : _BV(COM1A1) | _BV(COM1A0);
  // Without the timer the pin shows its port.
  digitalWrite(PULSE_PIN, is_high ? HIGH : LOW);
  TCCR1A = mode;
}

static void line_low() {
  TCCR1A &= ~(_BV(COM1A1) | _BV(COM1A0));
  digitalWrite(PULSE_PIN, LOW);
  is_high = false;
}

ISR(TIMER1_COMPA_vect) {
  if (state != FIRING) return;
  uint64_t now = now_steps();
  if (now < edge_steps) {  // Another round.
    load_edge();
    return;
  }
  if (is_high) {  // It fell.
    is_high = false;
    edge_steps = rise_steps + period_steps;
    bool is_over = (left == 1) || fired == 0xFFFFFFFFUL;
    if (left > 1) left--;
    if (is_over) {
      state = ARMED;
      line_low();
      push(DONE, fired, edge_steps);
      return;
    }
  } else {  // It rose.
    is_high = true;
    rise_steps = edge_steps;
    if (fired % report_every == 0) push(PULSE, fired, rise_steps);
    fired++;
    edge_steps = rise_steps + width_steps;
  }
  // An edge that is past already would come a round too late: it is made now, and told.
  if (now_steps() + 16 >= edge_steps) {
    push(OVERRUN, is_high ? fired - 1 : fired, 0);
    edge_steps = now_steps() + 40;
  }
  load_edge();
}

// ---- Lines ---------------------------------------------------------------------------------------------------------------

static uint16_t crc;

static void say_char(char c) {
  crc ^= (uint16_t)(uint8_t)c << 8;
  for (uint8_t i = 0; i < 8; i++) crc = (crc & 0x8000) ? (crc << 1) ^ 0x1021 : crc << 1;
  Serial.write(c);
}

static void say(const char *text) {
  while (*text) say_char(*text++);
}

static void say_number(uint64_t number) {
  char digits[21];
  uint8_t at = sizeof digits - 1;
  digits[at] = 0;
  do {
    digits[--at] = '0' + (char)(number % 10);
    number /= 10;
  } while (number);
  say_char(' ');
  say(digits + at);
}

static void begin_line() { crc = 0xFFFF; }

static void end_line() {
  static const char HEX_DIGITS[] = "0123456789ABCDEF";
  uint16_t sum = crc;
  Serial.write('*');
  for (int8_t shift = 12; shift >= 0; shift -= 4) Serial.write(HEX_DIGITS[(sum >> shift) & 15]);
  Serial.write('\n');
}

static void say_event(const Event &event) {
  begin_line();
  switch (event.kind) {
    case PULSE:
      say("! pulse");
      break;
    case DONE:
      say("! done");
      break;
    case OVERRUN:
      say("! overrun");
      break;
  }
  say_number(event.counter);
  if (event.kind != OVERRUN) say_number(event.steps * STEP_NANOS);
  end_line();
}

static void reject() {
  begin_line();
  say("! reject");
  end_line();
}

// The next field of a body, ended by a zero; none when there is none or it is empty.
static char *next_field(char *&rest) {
  if (!rest || !*rest || *rest == ' ') return nullptr;
  char *field = rest;
  char *space = strchr(rest, ' ');
  if (space) *space = 0;
  rest = space ? space + 1 : nullptr;
  return field;
}

// Decimal digits without leading zeros.
static bool read_number(char *&rest, uint64_t most, uint64_t &number) {
  const char *text = next_field(rest);
  if (!text || (text[0] == '0' && text[1])) return false;
  number = 0;
  for (; *text; text++) {
    if (*text < '0' || *text > '9' || number > (0xFFFFFFFFFFFFFFFFULL - (*text - '0')) / 10) return false;
    number = number * 10 + (*text - '0');
  }
  return number <= most;
}

// Ends the body before its checksum; whether the checksum is right.
static bool unseal(char *line, uint8_t length) {
  if (length < 5 || line[length - 5] != '*') return false;
  uint16_t found = 0;
  for (uint8_t i = length - 4; i < length; i++) {
    char c = line[i];
    if (!((c >= '0' && c <= '9') || (c >= 'A' && c <= 'F'))) return false;
    found = found << 4 | (c <= '9' ? c - '0' : c - 'A' + 10);
  }
  uint16_t sum = 0xFFFF;
  for (uint8_t i = 0; i + 5 < length; i++) {
    sum ^= (uint16_t)(uint8_t)line[i] << 8;
    for (uint8_t k = 0; k < 8; k++) sum = (sum & 0x8000) ? (sum << 1) ^ 0x1021 : sum << 1;
  }
  line[length - 5] = 0;
  return sum == found;
}

// ---- Requests ------------------------------------------------------------------------------------------------------------

// What is said again when a request comes again: its numbers, by the verb.
struct Reply {
  uint16_t id;
  const char *text;  // "ok verb" or "no reason"
  uint8_t count;
  uint64_t numbers[4];
  const char *word;  // Between text and numbers, or none.
};
static Reply last_reply = {0, "", 0, {0, 0, 0, 0}, nullptr};

static void say_reply() {
  char id[6];
  utoa(last_reply.id, id, 10);
  begin_line();
  say(id);
  say_char(' ');
  say(last_reply.text);
  if (last_reply.word) {
    say_char(' ');
    say(last_reply.word);
  }
  for (uint8_t i = 0; i < last_reply.count; i++) say_number(last_reply.numbers[i]);
  end_line();
}

static void say_hello(uint16_t id) {
  char text[6];
  utoa(id, text, 10);
  begin_line();
  say(text);
  say(" ok hello gv3-trigger 1 ");
  say(MODEL);
  say_char(' ');
  say(SERIAL_NUMBER);
  say_number((uint64_t)MIN_PERIOD_STEPS * STEP_NANOS);
  end_line();
}

static const char *arm(char *&rest, Reply &reply) {
  uint64_t period, width, every;
  const uint64_t any = 0xFFFFFFFFFFFFFFFFULL;
  if (!read_number(rest, any, period) || !read_number(rest, any, width) || !read_number(rest, 0xFFFFFFFFUL, every) || rest)
    return "no syntax";
  if (state == FIRING) return "no state";
  uint64_t steps = (period + STEP_NANOS / 2) / STEP_NANOS;
  if (steps < MIN_PERIOD_STEPS || period > MAX_PERIOD_NANOS) return "no range period";
  if (width < MIN_WIDTH_NANOS || width > period - MIN_WIDTH_NANOS) return "no range width";
  if (every < 1 || every > 1000) return "no range report";
  uint64_t wide = (width + STEP_NANOS / 2) / STEP_NANOS;
  wide = wide < MIN_WIDTH_STEPS ? MIN_WIDTH_STEPS : wide;
  wide = wide > steps - MIN_WIDTH_STEPS ? steps - MIN_WIDTH_STEPS : wide;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    period_steps = steps;
    width_steps = wide;
    report_every = (uint32_t)every;
    fired = 0;
    lost = 0;
    state = ARMED;
  }
  reply.count = 3;
  reply.numbers[0] = steps * STEP_NANOS;
  reply.numbers[1] = wide * STEP_NANOS;
  reply.numbers[2] = every;
  return "ok arm";
}

static const char *fire(char *&rest, Reply &reply) {
  uint64_t count;
  if (!read_number(rest, 0xFFFFFFFFUL, count) || rest) return "no syntax";
  if (state != ARMED || fired > 0) return "no state";
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
    left = (uint32_t)count;
    is_high = false;
    edge_steps = now_steps() + FIRE_DELAY_STEPS;
    state = FIRING;
    load_edge();
    TIFR1 = _BV(OCF1A);
    reply.numbers[0] = edge_steps * STEP_NANOS;
  }
  reply.count = 1;
  return "ok fire";
}

static const char *perform(const char *verb, char *&rest, Reply &reply) {
  if (!strcmp(verb, "arm")) return arm(rest, reply);
  if (!strcmp(verb, "fire")) return fire(rest, reply);
  if (rest) return "no syntax";
  uint64_t time;
  ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { time = now_steps() * STEP_NANOS; }
  if (!strcmp(verb, "time")) {
    reply.count = 1;
    reply.numbers[0] = time;
    return "ok time";
  }
  if (!strcmp(verb, "disarm")) {
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
      state = IDLE;
      line_low();
      reply.numbers[0] = fired;
    }
    reply.count = 1;
    return "ok disarm";
  }
  if (!strcmp(verb, "status")) {
    static const char *const NAMES[] = {"idle", "armed", "firing"};
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
      reply.word = NAMES[state];
      reply.numbers[0] = fired;
      reply.numbers[1] = lost;
    }
    reply.count = 3;
    reply.numbers[2] = time;
    return "ok status";
  }
  return "no syntax";
}

static void handle(char *line, uint8_t length) {
  uint64_t id;
  if (!unseal(line, length)) return reject();
  char *rest = line;
  if (!read_number(rest, 65535, id) || id == 0) return reject();
  if (id != last_reply.id) {
    const char *verb = next_field(rest);
    last_reply = {(uint16_t)id, "", 0, {0, 0, 0, 0}, nullptr};
    bool is_hello = verb && !strcmp(verb, "hello") && !rest;
    last_reply.text = is_hello ? "ok hello" : verb ? perform(verb, rest, last_reply) : "no syntax";
  }
  if (!strcmp(last_reply.text, "ok hello")) return say_hello(last_reply.id);
  say_reply();
}

// ---- The program ---------------------------------------------------------------------------------------------------------

void setup() {
  pinMode(PULSE_PIN, OUTPUT);
  digitalWrite(PULSE_PIN, LOW);
  Serial.begin(115200);
  TCCR1A = 0;           // Count through all 16 bits, leave the pin alone.
  TCCR1B = _BV(CS11);   // Clock divided by 8.
  TCNT1 = 0;
  TIMSK1 = _BV(TOIE1) | _BV(OCIE1A);
  begin_line();
  say("! boot 1");
  end_line();
}

void loop() {
  static char line[MAX_LINE + 2];
  static uint8_t length = 0;
  static bool is_too_long = false;
  while (queue_tail != queue_head) {
    // A line that does not fit into the port's buffer would keep the program from its requests.
    if (Serial.availableForWrite() < 48) break;
    Event event;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
      event = queue[queue_tail];
      queue_tail = (queue_tail + 1) % QUEUE;
    }
    say_event(event);
  }
  while (Serial.available()) {
    char c = (char)Serial.read();
    if (c != '\n') {
      if (length > MAX_LINE) is_too_long = true;
      else line[length++] = c;
      continue;
    }
    if (length && line[length - 1] == '\r') length--;
    line[length] = 0;
    if (is_too_long || length > MAX_LINE) reject();
    else if (length) handle(line, length);
    length = 0;
    is_too_long = false;
    break;  // Events are told between requests.
  }
}
