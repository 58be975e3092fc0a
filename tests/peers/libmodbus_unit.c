/* A unit made of libmodbus, for the tests of the master.
 *
 * build: gcc libmodbus_unit.c -o libmodbus_unit $(pkg-config --cflags --libs libmodbus)
 * usage: libmodbus_unit tcp PORT UNIT | libmodbus_unit rtu PATH UNIT
 *
 * Holding register n holds UNIT * 100 + n, input register n holds n, coil n is on when n is odd; 200 of each. Prints
 * "ready" when it listens. Serves one connection at a time.
 */
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define ENTRIES 200

static int serve(modbus_t *line, modbus_mapping_t *map) {
    uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
    for (;;) {
        int length = modbus_receive(line, request);
        if (length < 0)
            return errno;
        /* 0: a frame for another unit of the line. */
        if (length > 0)
            modbus_reply(line, request, length, map);
    }
}

int main(int argc, char **argv) {
    if (argc != 4) {
        fprintf(stderr, "usage: libmodbus_unit tcp PORT UNIT | libmodbus_unit rtu PATH UNIT\n");
        return 2;
    }
    int tcp = strcmp(argv[1], "tcp") == 0, unit = atoi(argv[3]);
    modbus_t *line = tcp ? modbus_new_tcp("127.0.0.1", atoi(argv[2])) : modbus_new_rtu(argv[2], 19200, 'N', 8, 1);
    modbus_mapping_t *map = modbus_mapping_new(ENTRIES, ENTRIES, ENTRIES, ENTRIES);
    if (!line || !map || modbus_set_slave(line, unit) < 0) {
        fprintf(stderr, "libmodbus_unit: %s\n", modbus_strerror(errno));
        return 1;
    }
    for (int n = 0; n < ENTRIES; n++) {
        map->tab_bits[n] = map->tab_input_bits[n] = n % 2;
        map->tab_registers[n] = unit * 100 + n;
        map->tab_input_registers[n] = n;
    }
    int listener = -1;
    if (tcp ? (listener = modbus_tcp_listen(line, 1)) < 0 : modbus_connect(line) < 0) {
        fprintf(stderr, "libmodbus_unit: %s\n", modbus_strerror(errno));
        return 1;
    }
    puts("ready");
    fflush(stdout);
    for (;;) {
        if (tcp && modbus_tcp_accept(line, &listener) < 0)
            return 1;
        int why = serve(line, map);
        if (tcp)
            modbus_close(line);
        else if (why != EMBBADCRC && why != ETIMEDOUT && why != EMBBADDATA)
            return 1;
    }
}
