/* The yardstick of `dinrail bench modbus`: the plainest server libmodbus allows, one client at a time.
 *
 * build: gcc -O2 libmodbus_server.c -o libmodbus_server $(pkg-config --cflags --libs libmodbus)
 * usage: libmodbus_server PORT
 */
#include <errno.h>
#include <modbus.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <unistd.h>

int main(int argc, char **argv) {
    if (argc != 2) {
        fprintf(stderr, "usage: libmodbus_server PORT\n");
        return 2;
    }
    modbus_t *line = modbus_new_tcp("127.0.0.1", atoi(argv[1]));
    modbus_mapping_t *map = modbus_mapping_new(1000, 1000, 1000, 1000);
    int listener = line && map ? modbus_tcp_listen(line, 1) : -1;
    if (listener < 0) {
        fprintf(stderr, "libmodbus_server: %s\n", modbus_strerror(errno));
        return 1;
    }
    puts("ready");
    fflush(stdout);
    for (;;) {
        int client = modbus_tcp_accept(line, &listener);
        if (client < 0)
            return 1;
        int on = 1;
        setsockopt(client, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
        uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
        for (;;) {
            int length = modbus_receive(line, request);
            if (length < 0)
                break;
            if (length > 0)
                modbus_reply(line, request, length, map);
        }
        close(client);
    }
}
