// Covariance update by one measurement with fixed-size Eigen matrices: prints n, m, Joseph form or not, the trace of
// the result and processor nanoseconds per update. Compiled and run by eigen.py.
#include <Eigen/Dense>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <ctime>

template <int n, int m, bool joseph>
void run(long repetitions) {
    Eigen::Matrix<double, n, n> P0, P, N;
    Eigen::Matrix<double, m, n> H;
    const double r = 0.04;
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) P0(i, j) = (i == j ? 1.0 : 0.0) + 0.5 / (1.0 + std::abs(i - j));
    for (int k = 0; k < m; ++k)
        for (int j = 0; j < n; ++j) H(k, j) = std::sin(1.0 + 2.0 * k + 3.0 * j);
    const std::clock_t begun = std::clock();
    for (long repetition = 0; repetition < repetitions; ++repetition) {
        P = P0;
        asm volatile("" : : "r"(P.data()), "r"(H.data()) : "memory");
        Eigen::Matrix<double, n, m> C, K, V;
        Eigen::Matrix<double, m, m> S;
        C.noalias() = P * H.transpose();
        S.noalias() = H * C;
        S.diagonal().array() += r;
        const Eigen::LLT<Eigen::Matrix<double, m, m>> factor(S);
        K = factor.solve(C.transpose()).transpose();
        if (joseph) {
            N = P;
            N.noalias() -= K * C.transpose();
            V.noalias() = N * H.transpose();
            V -= r * K;
            P = N;
            P.noalias() -= V * K.transpose();
        } else {
            P.noalias() -= K * C.transpose();
        }
        asm volatile("" : : "r"(P.data()) : "memory");
    }
    const double seconds = double(std::clock() - begun) / CLOCKS_PER_SEC;
    std::printf("%d %d %d %.17g %.6g\n", n, m, int(joseph), P.trace(), seconds / repetitions * 1e9);
}

int main(int, char** arguments) {
    const long repetitions = std::atol(arguments[1]);
    run<8, 3, true>(repetitions);
    run<8, 3, false>(repetitions);
    run<16, 6, true>(repetitions / 4);
    run<16, 6, false>(repetitions / 4);
}
