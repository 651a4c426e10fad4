/* Hand a camera's image lines, inertial data and GNSS to triline from a driver in C, over TCP.
 *
 *     cc -O2 -o publish_sensors publish_sensors.c -lm && ./publish_sensors 127.0.0.1 5555 10
 *
 * The other side is a sensor of the flight folder: [[sensor]] kind = "stream", address = "listen://127.0.0.1:5555".
 * A record is a line of text; after LINES come the pixels, little-endian. Times are UTC in ns since the Unix epoch. */
#include <math.h>
#include <netdb.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { SAMPLES = 64, BLOCK = 20, RATE = 200 }; /* pixels of a line, lines of a block, lines a second */

static int64_t now_ns(void) {
    struct timespec t;
    clock_gettime(CLOCK_REALTIME, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static FILE *join(const char *host, const char *port) {
    struct addrinfo hints = {.ai_socktype = SOCK_STREAM}, *found = NULL;
    if (getaddrinfo(host, port, &hints, &found)) return NULL;
    int s = socket(found->ai_family, found->ai_socktype, 0);
    return connect(s, found->ai_addr, found->ai_addrlen) ? NULL : fdopen(s, "w");
}

int main(int argc, char **argv) {
    FILE *out = argc == 4 ? join(argv[1], argv[2]) : NULL;
    if (!out) return fprintf(stderr, "%s HOST PORT SECONDS: nobody listens there\n", argv[0]), 1;
    uint16_t pixels[BLOCK][SAMPLES];
    const int64_t period = 1000000000 / RATE, start = now_ns();
    for (long n = 0; n < atof(argv[3]) * RATE; n++) { /* a turn for each image line */
        const int64_t t = start + n * period;
        while (now_ns() < t) usleep(200);
        /* forward, right, down: specific force in m/s^2, angular rate in rad/s, over the interval that ends at t */
        fprintf(out, "IMU %lld %lld %.9f %.9f %.9f %.9f %.9f %.9f\n", (long long)t, (long long)period,
                0.1 * sin(n * 0.01), 0.0, -9.81, 0.0, 0.0, 0.001 * cos(n * 0.01));
        if (n % (RATE / 5) == 0) /* latitude and longitude in degrees, height above the ellipsoid; sigmas in m */
            fprintf(out, "GNSS %lld %.10f %.10f %.4f 0.02 0.02 0.04\n", (long long)t, 47.9 + n * 3e-6, 11.1, 1500.0);
        for (int i = 0; i < SAMPLES; i++) pixels[n % BLOCK][i] = (uint16_t)(n * 7 + i); /* as the camera gives them */
        if (n % BLOCK == BLOCK - 1) { /* CCD line, strip, its first line here, time of that, period, lines, samples, bits */
            fprintf(out, "LINES N S%lld %ld %lld %lld %d %d 16\n", (long long)(start / 1000000000), n - BLOCK + 1,
                    (long long)(t - (BLOCK - 1) * period), (long long)period, BLOCK, SAMPLES);
            fwrite(pixels, sizeof pixels, 1, out);
        }
        fflush(out); /* or every 20 ms, where the processor is small */
    }
    return fclose(out) ? 1 : 0;
}
