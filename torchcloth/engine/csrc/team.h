// Threads that go through one scene together. A substep has a dozen pieces of some microseconds each: who waits for the
// next one watches for it, and sleeps only after a while.
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

// While it lives, numbers too small for full precision count as 0: where a wave has not yet arrived, processors spend
// twice the time on them.
class Flush {
#ifdef __SSE2__
    unsigned before = __builtin_ia32_stmxcsr();

  public:
    Flush() { __builtin_ia32_ldmxcsr(before | 0x8040); }
    ~Flush() { __builtin_ia32_ldmxcsr(before); }
#endif
};

// Whether work is done together or alone: what a team has learned.
struct Habit {
    static constexpr int FIRST = 250, TERM = 8000;  // rounds to the next trial: the more, the more trials agree
    bool alone = false, before = false;             // now, and after the last trial
    int round = 0, term = FIRST;                    // of a trial, or since it; to the next one
    static constexpr int TRIAL = 32, COUNT = 16;  // rounds each way, of which the last ones count: a new thread takes
                                                  // some to come to a processor of its own
    std::chrono::steady_clock::duration took[2][COUNT];  // together, alone
};

// Processors that this process keeps busy with simulations: who wants helpers gets those that are free, and no more.
class Seats {
    static std::atomic<int>& taken() {
        static std::atomic<int> count{0};
        static std::atomic<pid_t> process{getpid()};  // one that was forked off has its parent's count, not its threads
        pid_t last = process, now = getpid();
        if (last != now && process.compare_exchange_strong(last, now)) count = 0;
        return count;
    }

  public:
    int own;
    explicit Seats(int wanted) : own(wanted) { taken() += own; }
    struct Free {};
    Seats(int most, Free) : own(0) {
        const int cores = std::max(1, int(std::thread::hardware_concurrency()));
        for (int now = taken(); own = std::clamp(cores - now, 0, most), own > 0;)
            if (taken().compare_exchange_weak(now, now + own)) break;
    }
    Seats(const Seats&) = delete;
    Seats& operator=(const Seats&) = delete;
    ~Seats() { taken() -= own; }
};

// A thread that works for one team after the other and sleeps in between: a new one takes milliseconds to come to a
// processor of its own. It ends with the process.
class Member {
    struct alignas(64) {
        std::atomic<int64_t> piece{1};  // even: offered, odd: somebody has taken it
        const void* work = nullptr;
        void (*call)(const void*, int) = nullptr;
        int part = 0;
    } offer;
    struct alignas(64) {
        std::atomic<int64_t> piece{1};  // the last one that the thread did
    } done;
    alignas(64) int64_t piece = 0;  // that was offered last: for the giver alone

  public:
    Member() { std::thread([this] { serve(); }).detach(); }

    void give(const void* work, void (*call)(const void*, int), int part) {
        offer.work = work, offer.call = call, offer.part = part;
        offer.piece.store(piece += 2, std::memory_order_release);
        offer.piece.notify_one();
    }
    bool is_done() const { return done.piece.load(std::memory_order_acquire) == piece; }
    // Whether it is, after watching for a while.
    bool is_done_soon() const {
        for (int64_t k = 0; k < WATCH && !is_done(); k++) rest(k);
        return is_done();
    }
    // Whether the thread has not begun; the caller does the work then.
    bool take_back() { return take(piece); }

  private:
    static constexpr int64_t WATCH = 100000;  // some 50 us
    static void rest([[maybe_unused]] int64_t k) {
#if defined(__x86_64__)
        if (k % 256 == 0) __builtin_ia32_pause();  // seldom: who pauses on and on is put aside by a virtual machine's host
#endif
    }
    bool take(int64_t wanted) { return offer.piece.compare_exchange_strong(wanted, wanted + 1, std::memory_order_acq_rel); }
    void serve() {
        [[maybe_unused]] const Flush flush;
        for (;;) {
            int64_t next = offer.piece.load(std::memory_order_acquire);
            for (int64_t k = 0; next % 2 != 0; k++, next = offer.piece.load(std::memory_order_acquire))
                if (k > WATCH) offer.piece.wait(next);
                else rest(k);
            if (!take(next)) continue;
            offer.call(offer.work, offer.part);
            done.piece.store(next, std::memory_order_release);
        }
    }
};

// The members that no team has now.
class Pool {
    std::mutex guard;
    std::vector<Member*> free;
    size_t all = 0;
    const pid_t process = getpid();

  public:
    // A process that was forked off has none of its parent's threads, and perhaps a lock that nobody will open.
    static Pool& own() {
        static std::atomic<Pool*> pool{nullptr};
        Pool* now = pool.load();
        if (now != nullptr && now->process == getpid()) return *now;
        Pool* fresh = new Pool;
        if (pool.compare_exchange_strong(now, fresh)) return *fresh;
        delete fresh;
        return *now;
    }
    Member* hire() {
        std::lock_guard<std::mutex> lock(guard);
        if (free.empty()) {
            free.reserve(all + 1);  // to leave must not fail
            Member* one = new Member;
            all++;
            return one;
        }
        Member* one = free.back();
        free.pop_back();
        return one;
    }
    void leave(const std::vector<Member*>& members) {
        std::lock_guard<std::mutex> lock(guard);
        free.insert(free.end(), members.begin(), members.end());
    }
};

class Team {
    using Clock = std::chrono::steady_clock;
    std::vector<Member*> others;  // from the first work for several on

  public:
    const int size;
    Habit habit;

    Team(int64_t size, const Habit& habit)
        : size(int(size)), habit(habit), seats(int(size) - 1, Seats::Free{}), began(Clock::now()) {}
    Team(const Team&) = delete;
    Team& operator=(const Team&) = delete;
    ~Team() { Pool::own().leave(others); }

    // job(part) for parts 0 to parts - 1 at once, by as many threads as there are seats. What nobody has begun when the
    // caller is done with its own part, the caller does; and all of it for a while when it had to wait for a thread that
    // other processes keep from running. What a job throws would end the process.
    template <class F>
    void run(int parts, const F& job) {
        int helped = std::min(parts, 1 + seats.own);
        if (habit.alone || helped == 1 || (delayed && Clock::now() < delayed_until)) {
            for (int part = 0; part < parts; part++) job(part);
            return;
        }
        delayed = false;
        try {
            others.reserve(helped - 1);
            while (int(others.size()) < helped - 1) others.push_back(Pool::own().hire());
        } catch (const std::exception&) {  // no more threads are to be had
            helped = 1 + int(others.size());
        }
        auto call = [](const void* to, int part) { (*static_cast<const F*>(to))(part); };
        for (int part = 1; part < helped; part++) others[part - 1]->give(&job, call, part);
        [&]() noexcept {  // the others may be at it still
            job(0);
            for (int part = helped; part < parts; part++) job(part);
            for (int part = 1; part < helped; part++)
                if (Member& other = *others[part - 1]; !other.is_done() && other.take_back()) job(part);
                else await(other);
        }();
    }

    // To be called once in every round of the same work, which is tried together and alone, and then done as was faster:
    // results are the same, and how soon one processor sees what another one wrote differs by a factor between machines.
    void weigh() {
        const auto now = Clock::now();
        Habit& h = habit;
        if ((delayed || seats.own == 0) && h.round <= 2 * Habit::TRIAL) h.round = 0;
        const int counted = (h.round - 1) % Habit::TRIAL - (Habit::TRIAL - Habit::COUNT);
        if (h.round > 0 && h.round <= 2 * Habit::TRIAL && counted >= 0) h.took[h.alone][counted] = now - began;
        if (h.round < 2 * Habit::TRIAL) h.alone = h.round >= Habit::TRIAL;
        else if (h.round == 2 * Habit::TRIAL) {
            h.alone = middle(h.took[1]) < middle(h.took[0]);
            h.term = h.alone == h.before ? std::min(2 * h.term, Habit::TERM) : Habit::FIRST;
            h.before = h.alone;
        }
        h.round = h.round < 2 * Habit::TRIAL + h.term ? h.round + 1 : 0;
        began = now;
    }

  private:
    const Seats seats;
    Clock::time_point began;  // the present round
    bool delayed = false;
    int patience = 1;  // for how many times what was lost the caller works alone: more when it happens again soon
    Clock::time_point delayed_until;

    static Clock::duration middle(Clock::duration* took) {
        std::nth_element(took, took + Habit::COUNT / 2, took + Habit::COUNT);
        return took[Habit::COUNT / 2];
    }

    void await(const Member& other) {
        if (other.is_done_soon()) return;
        const auto before = Clock::now();
        while (!other.is_done()) std::this_thread::yield();
        const auto now = Clock::now();
        patience = before - delayed_until < 10 * (now - before) ? std::min(2 * patience, 64) : 1;
        delayed = true, delayed_until = now + patience * (now - before);
    }
};

// Part `m` of `parts` of so many items: where it begins. It ends where the next one does.
inline int begin_of(int m, int parts, int count) { return int(int64_t(count) * m / parts); }

}  // namespace tc
