/* What random calls of both versions of FMI share: chance, what is counted, and threads. Compiled with
   AddressSanitizer and UndefinedBehaviorSanitizer or ThreadSanitizer, which end the program at the first
   fault.

       fuzz SEQUENCES SEED [THREADS]    as many sequences in each thread, at the same time */
#include <math.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmu.c"

#define CHECK(condition)                                                                     \
    do {                                                                                     \
        if (!(condition)) {                                                                  \
            fprintf(stderr, "line %d: not %s\n", __LINE__, #condition);                      \
            exit(1);                                                                         \
        }                                                                                    \
    } while (0)

enum { LONGEST = 40 };
static __thread uint64_t seed;
static __thread long logged, refused, done;

static void refuse_to_instantiate(void); /* of wrong arguments */
static void sequence(void);              /* of random calls on an instance */

static unsigned pick(unsigned below) /* xorshift64* */
{
    seed ^= seed >> 12, seed ^= seed << 25, seed ^= seed >> 27;
    return (unsigned)((seed * UINT64_C(2685821657736338717)) >> 33) % below;
}

static double number(void)
{
    static const double odd[] = {0.0, -0.0, 1e-320, -1.0, 1e6, -1e6, 1e300, -1e300, 1.7e308};
    switch (pick(8)) {
    case 0: return pick(2) ? NAN : pick(2) ? INFINITY : -INFINITY;
    case 1: return odd[pick(9)];
    default: return (pick(2001) - 1000.0) * 1e-3;
    }
}

typedef struct {
    long sequences;
    uint64_t seed;
} Share;

static void *run(void *given)
{
    const Share *share = given;
    seed = share->seed;
    for (long i = 0; i < share->sequences; i++)
        sequence();
    printf("%ld sequences, %ld calls done, %ld refused, %ld messages\n", share->sequences, done,
           refused, logged);
    return NULL;
}

int main(int count, char *argument[])
{
    enum { MOST = 16 };
    const long sequences = count > 1 ? atol(argument[1]) : 1000;
    const uint64_t first = count > 2 ? strtoull(argument[2], NULL, 10) : 0;
    const int threads = count > 3 ? atoi(argument[3]) : 1;
    pthread_t thread[MOST];
    Share share[MOST];
    CHECK(threads > 0 && threads <= MOST);
    refuse_to_instantiate();
    for (int i = 0; i < threads; i++) {
        share[i] = (Share){sequences, (first + (uint64_t)i) * UINT64_C(0x9e3779b97f4a7c15) + 1};
        CHECK(!pthread_create(&thread[i], NULL, run, &share[i]));
    }
    for (int i = 0; i < threads; i++)
        CHECK(!pthread_join(thread[i], NULL));
    return 0;
}
