/* Hand a camera's image lines, attitude or inertial data, and GNSS to triline from a driver in C, over TCP.
 *
 *     cc -O2 -o publish_sensors publish_sensors.c && ./publish_sensors 127.0.0.1 5555 < measured
 *
 * The other side is a sensor of the flight folder: [[sensor]] kind = "stream", address = "listen://127.0.0.1:5555".
 * Standard input stands for the devices, a row for each thing in the order in which they are known (t: ns from now on):
 *     gnss t lat_deg lon_deg height_m sigma_m          imu t interval_ns fx fy fz wx wy wz
 *     attitude t roll pitch heading sigma_rad          lines t ccd first_line period_ns lines samples bits, then pixels
 * A record is a line of text; after LINES come the pixels, little-endian. Times are UTC in ns since the Unix epoch. */
#include <inttypes.h>
#include <netdb.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

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
    FILE *out = argc == 3 ? join(argv[1], argv[2]) : NULL;
    if (!out) return fprintf(stderr, "%s HOST PORT: nobody listens there\n", argv[0]), 1;
    static char pixels[1 << 24], kind[16], ccd[16], strip[16];
    const int64_t start = now_ns() + 1000000000;
    strftime(strip, sizeof strip, "S%H%M%S", gmtime(&(time_t){start / 1000000000})); /* a name for each strip */
    int64_t t, period, first, records = 0;
    int lines, samples, bits, read;
    double v[6];
    for (; (read = scanf("%15s %" SCNd64, kind, &t)) == 2; records++) { /* a turn for each thing measured */
        size_t size = 0;
        lines = 1, period = 0, t += start;
        if (!strcmp(kind, "gnss") && scanf("%lf %lf %lf %lf", v, v + 1, v + 2, v + 3) == 4) {
            fprintf(out, "GNSS %" PRId64 " %.10f %.10f %.6f %g %g %g\n", t, v[0], v[1], v[2], v[3], v[3], v[3]);
        } else if (!strcmp(kind, "imu") && /* forward, right, down: m/s^2, rad/s, over the interval that ends at t */
                   scanf("%" SCNd64 "%lf %lf %lf %lf %lf %lf", &period, v, v + 1, v + 2, v + 3, v + 4, v + 5) == 7) {
            fprintf(out, "IMU %" PRId64 " %" PRId64 " %.9f %.9f %.9f %.9f %.9f %.9f\n", t, period, v[0], v[1], v[2],
                    v[3], v[4], v[5]);
        } else if (!strcmp(kind, "attitude") && scanf("%lf %lf %lf %lf", v, v + 1, v + 2, v + 3) == 4) {
            fprintf(out, "ATTITUDE %" PRId64 " %.10f %.10f %.10f %g %g %g\n", t, v[0], v[1], v[2], v[3], v[3], v[3]);
        } else if (!strcmp(kind, "lines") && scanf("%15s %" SCNd64 "%" SCNd64 "%d %d %d%*1[\n]", ccd, &first, &period,
                                                   &lines, &samples, &bits) == 6 &&
                   (size = (size_t)lines * samples * bits / 8) <= sizeof pixels && fread(pixels, size, 1, stdin)) {
            fprintf(out, "LINES %s %s %" PRId64 " %" PRId64 " %" PRId64 " %d %d %d\n", ccd, strip, first, t, period,
                    lines, samples, bits);
        } else break;
        while (now_ns() < t + (lines - 1) * period) usleep(200); /* until the last line has been read */
        fwrite(pixels, size, 1, out);
        fflush(out); /* or every 20 ms, where the processor is small */
    }
    if (read != EOF) fprintf(stderr, "row %" PRId64 " of %s: cannot be read\n", records + 1, kind);
    printf("%" PRId64 " records\n", records);
    return fclose(out) || read != EOF;
}
