/* Seconds from any start, for `clock` of the settings. Not part of the written code. */

#if defined(_WIN32)
double mhe_seconds(void) { return (double)clock() / CLOCKS_PER_SEC; } /* time that passes, there */
#else
double mhe_seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}
#endif
