// Threads that go through one scene together. A substep has a dozen pieces of some microseconds each. A thread that
// waits for the next piece therefore polls for a while before it sleeps, which OpenMP's runtimes do not promise, and
// which survives fork.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <mutex>
#include <thread>
#include <unistd.h>
#include <vector>

namespace tc {

// While it lives, denormal numbers count as 0. Where a wave has not yet arrived, processors spend twice the time on
// them.
class FlushDenormals {
#ifdef __SSE2__
    unsigned before = __builtin_ia32_stmxcsr();

  public:
    FlushDenormals() { __builtin_ia32_ldmxcsr(before | 0x8040); }
    ~FlushDenormals() { __builtin_ia32_ldmxcsr(before); }
#endif
};

// Whether work is done in parallel or serially, as a team has measured it. Times are compared in trials.
struct ParallelPolicy {
    // rounds to the next trial: more while trials agree
    static constexpr int FIRST_INTERVAL = 250, MAX_INTERVAL = 8000;
    bool is_serial = false, was_serial = false;                      // now, and after the last trial
    int round = 0, interval = FIRST_INTERVAL;  // round of a trial or since it; rounds to the next one
    // Rounds of a trial for each way, of which the last ones count. A new thread needs some rounds to get a processor.
    static constexpr int TRIAL_ROUNDS = 32, COUNTED_ROUNDS = 16;
    std::chrono::steady_clock::duration times[2][COUNTED_ROUNDS];  // parallel, serial
};

// Processors that simulations of this process keep busy. A request for helpers gets those that are free, and no more.
class CoreReservation {
    static std::atomic<int>& reserved() {
        static std::atomic<int> count{0};
        static std::atomic<pid_t> process{getpid()};  // a forked process has its parent's count, but not its threads
        pid_t last = process, now = getpid();
        if (last != now && process.compare_exchange_strong(last, now)) count = 0;
        return count;
    }

  public:
    int count;
    explicit CoreReservation(int wanted) : count(wanted) { reserved() += count; }
    struct OnlyFree {};
    CoreReservation(int most, OnlyFree) : count(0) {
        const int cores = std::max(1, int(std::thread::hardware_concurrency()));
        for (int now = reserved(); count = std::clamp(cores - now, 0, most), count > 0;)
            if (reserved().compare_exchange_weak(now, now + count)) break;
    }
    CoreReservation(const CoreReservation&) = delete;
    CoreReservation& operator=(const CoreReservation&) = delete;
    ~CoreReservation() { reserved() -= count; }
};

// A thread that works for one team after the other and sleeps in between, because a new thread takes milliseconds to
// get a processor. It ends with the process.
class Worker {
    struct alignas(64) {
        std::atomic<int64_t> piece{1};  // even: offered, odd: taken
        const void* work = nullptr;
        void (*call)(const void*, int) = nullptr;
        int part = 0;
    } offer;
    struct alignas(64) {
        std::atomic<int64_t> piece{1};  // last one that the thread did
    } done;
    alignas(64) int64_t piece = 0;  // last one that was offered; only the offering thread reads it

  public:
    Worker() { std::thread([this] { serve(); }).detach(); }

    void give(const void* work, void (*call)(const void*, int), int part) {
        offer.work = work, offer.call = call, offer.part = part;
        offer.piece.store(piece += 2, std::memory_order_release);
        offer.piece.notify_one();
    }
    bool is_done() const { return done.piece.load(std::memory_order_acquire) == piece; }
    // Whether it is done after polling for a while.
    bool is_done_soon() const {
        for (int64_t k = 0; k < POLLS && !is_done(); k++) pause(k);
        return is_done();
    }
    // Whether the thread has not begun; the caller does the work then.
    bool take_back() { return take(piece); }

  private:
    static constexpr int64_t POLLS = 100000;  // some 50 us
    static void pause([[maybe_unused]] int64_t k) {
#if defined(__x86_64__)
        if (k % 256 == 0) __builtin_ia32_pause();  // seldom: a virtual machine's host suspends who pauses all the time
#endif
    }
    bool take(int64_t wanted) {
        return offer.piece.compare_exchange_strong(wanted, wanted + 1, std::memory_order_acq_rel);
    }
    void serve() {
        [[maybe_unused]] const FlushDenormals flush;
        for (;;) {
            int64_t next = offer.piece.load(std::memory_order_acquire);
            for (int64_t k = 0; next % 2 != 0; k++, next = offer.piece.load(std::memory_order_acquire))
                if (k > POLLS) offer.piece.wait(next);
                else pause(k);
            if (!take(next)) continue;
            offer.call(offer.work, offer.part);
            done.piece.store(next, std::memory_order_release);
        }
    }
};

// The workers that no team uses now.
class WorkerPool {
    std::mutex mutex;
    std::vector<Worker*> free;
    size_t all = 0;
    const pid_t process = getpid();

  public:
    // A forked process has none of its parent's threads, and perhaps a lock that no thread will open: it gets a new
    // pool.
    static WorkerPool& of_process() {
        static std::atomic<WorkerPool*> pool{nullptr};
        WorkerPool* now = pool.load();
        if (now != nullptr && now->process == getpid()) return *now;
        WorkerPool* fresh = new WorkerPool;
        if (pool.compare_exchange_strong(now, fresh)) return *fresh;
        delete fresh;
        return *now;
    }
    Worker* acquire() {
        std::lock_guard<std::mutex> lock(mutex);
        if (free.empty()) {
            free.reserve(all + 1);  // release must not fail
            Worker* worker = new Worker;
            all++;
            return worker;
        }
        Worker* worker = free.back();
        free.pop_back();
        return worker;
    }
    void release(const std::vector<Worker*>& workers) {
        std::lock_guard<std::mutex> lock(mutex);
        free.insert(free.end(), workers.begin(), workers.end());
    }
};

class ThreadTeam {
    using Clock = std::chrono::steady_clock;
    std::vector<Worker*> workers;  // acquired when several threads first work

  public:
    const int size;
    ParallelPolicy policy;

    ThreadTeam(int64_t size, const ParallelPolicy& policy)
        : size(int(size)),
          policy(policy),
          cores(int(size) - 1, CoreReservation::OnlyFree{}),
          round_start(Clock::now()) {}
    ThreadTeam(const ThreadTeam&) = delete;
    ThreadTeam& operator=(const ThreadTeam&) = delete;
    ~ThreadTeam() { WorkerPool::of_process().release(workers); }

    // Runs job(part) for parts 0 to parts - 1 on as many threads as there are cores. When the caller has done its own
    // part, it does the parts that no thread has begun. If it had to wait for a thread that other processes keep from
    // running, it works serially for a while. A job must not throw: that would end the process.
    template <class F>
    void run(int parts, const F& job) {
        int threads = std::min(parts, 1 + cores.count);
        if (policy.is_serial || threads == 1 || (delayed && Clock::now() < delayed_until)) {
            for (int part = 0; part < parts; part++) job(part);
            return;
        }
        delayed = false;
        try {
            workers.reserve(threads - 1);
            while (int(workers.size()) < threads - 1) workers.push_back(WorkerPool::of_process().acquire());
        } catch (const std::exception&) {  // the system gives no more threads
            threads = 1 + int(workers.size());
        }
        auto call = [](const void* to, int part) { (*static_cast<const F*>(to))(part); };
        for (int part = 1; part < threads; part++) workers[part - 1]->give(&job, call, part);
        [&]() noexcept {  // the workers may still be running
            job(0);
            for (int part = threads; part < parts; part++) job(part);
            for (int part = 1; part < threads; part++)
                if (Worker& worker = *workers[part - 1]; !worker.is_done() && worker.take_back()) job(part);
                else await(worker);
        }();
    }

    // Call it once in every round of the same work. The work is tried in parallel and serially, and then done the
    // faster way. Results are the same; how soon one processor sees what another wrote differs by a factor between
    // machines.
    void update_policy() {
        const auto now = Clock::now();
        ParallelPolicy& p = policy;
        constexpr int TRIAL = ParallelPolicy::TRIAL_ROUNDS, COUNTED = ParallelPolicy::COUNTED_ROUNDS;
        if ((delayed || cores.count == 0) && p.round <= 2 * TRIAL) p.round = 0;
        const int counted = (p.round - 1) % TRIAL - (TRIAL - COUNTED);
        if (p.round > 0 && p.round <= 2 * TRIAL && counted >= 0) p.times[p.is_serial][counted] = now - round_start;
        if (p.round < 2 * TRIAL) p.is_serial = p.round >= TRIAL;
        else if (p.round == 2 * TRIAL) {
            p.is_serial = median(p.times[1]) < median(p.times[0]);
            p.interval = p.is_serial == p.was_serial ? std::min(2 * p.interval, ParallelPolicy::MAX_INTERVAL)
                                                     : ParallelPolicy::FIRST_INTERVAL;
            p.was_serial = p.is_serial;
        }
        p.round = p.round < 2 * TRIAL + p.interval ? p.round + 1 : 0;
        round_start = now;
    }

  private:
    const CoreReservation cores;
    Clock::time_point round_start;
    bool delayed = false;
    int patience = 1;  // the caller works serially for so many times the delay: more when delays follow each other
    Clock::time_point delayed_until;

    static Clock::duration median(Clock::duration* times) {
        constexpr int COUNTED = ParallelPolicy::COUNTED_ROUNDS;
        std::nth_element(times, times + COUNTED / 2, times + COUNTED);
        return times[COUNTED / 2];
    }

    void await(const Worker& worker) {
        if (worker.is_done_soon()) return;
        const auto before = Clock::now();
        while (!worker.is_done()) std::this_thread::yield();
        const auto now = Clock::now();
        patience = before - delayed_until < 10 * (now - before) ? std::min(2 * patience, 64) : 1;
        delayed = true, delayed_until = now + patience * (now - before);
    }
};

// Where part `m` of `parts` of so many items begins. It ends where the next part begins.
inline int begin_of(int m, int parts, int count) { return int(int64_t(count) * m / parts); }

}  // namespace tc
