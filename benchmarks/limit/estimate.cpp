// What the estimate of data/falcon costs by itself: a yardstick for `rovgraph smooth`.
//
//     estimate LOG.csv TRAJECTORY.csv [ITERATIONS]
//
// The same estimate in kind: a keyframe at every ping, the IMU preintegrated between them, all measurements linearised
// at their own times, a chain of keyframes with a border of constant calibration eliminated by Householder reflections
// of whitened rows, Gauss-Newton with robust weights and gates, marginal covariances of all keyframes, a CSV file.
// It has none of the rest: no check, no filter, no search for faults, no verdict, no page. The numbers of
// data/falcon/config.yaml stand below.
//
// Frames: n is north, east, down; b is the body; the state's origin is the IMU. An error of a keyframe is that of its
// rotation (in b, right perturbation), position, velocity (in n), accelerometer's and gyro's bias (in b).
//
// Preintegration and its covariance: Forster et al. 2017. MIT licence.

#include <Eigen/Dense>
#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <string>
#include <vector>

using Eigen::Matrix3d;
using Eigen::Vector3d;
using Vector6d = Eigen::Matrix<double, 6, 1>;

constexpr double RAD = M_PI / 180.0;
enum { THETA = 0, P = 3, V = 6, ACC = 9, GYR = 12, STATE = 15 };  // components of a keyframe's error
// The calibration that is estimated: yaw of the DVL, offset and deviation of its compass, hard iron, dip and magnitude
enum { YAW = 0, OFFSET, DEVIATION, IRON = DEVIATION + 2, DIP = IRON + 3, FIELD, CONSTANTS };
constexpr int BORDER = CONSTANTS + 1;                  // and the right-hand side
constexpr int WIDTH = 2 * STATE + BORDER;
using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
using Conditional = Eigen::Matrix<double, STATE, WIDTH, Eigen::RowMajor>;  // triangle, next keyframe, border

namespace config {
const double gravity = 9.81, declination = 4.5 * RAD, dip = 72.0 * RAD;
const Vector3d imu_rpy(176.6 * RAD, 1.2 * RAD, 0.0), imu_arm(-0.11, 0.22, -0.1);
const double acc_noise = 0.000782, gyr_noise = 0.000637, acc_walk = 0.0003, gyr_walk = 1e-5;
const Vector3d dvl_rpy(180.0 * RAD, 0.0, 45.0 * RAD), dvl_arm(0.24, 0.0, 0.33), dvl_sd(0.00374, 0.00353, 0.00155);
const double mag_sd = 0.22 * RAD * std::cos(dip), heading_sd = 0.25 * RAD, depth_sd = 0.02, max_speed = 3.0;
const double shortest = 0.05;  // between keyframes [s]
const double gate_sd = 6.0, tilt_sd = 2.0 * RAD, start_heading_sd = 5.0 * RAD, start_sd = 0.1, start_down_sd = 10.0;
const double start_velocity_sd = 1.0, acc_bias_sd = 0.02, gyr_bias_sd = 0.5 * RAD;
const double constant_sd[CONSTANTS] = {
    5 * RAD, 5 * RAD, 3 * RAD, 3 * RAD, 0.02, 0.02, 0.02, 3 * RAD, 0.05};
}  // namespace config

// ---- rotations -------------------------------------------------------------------------------------------------

Matrix3d skew(const Vector3d& a) {
    Matrix3d S;
    S << 0, -a.z(), a.y(), a.z(), 0, -a.x(), -a.y(), a.x(), 0;
    return S;
}

Matrix3d exp_rotation(const Vector3d& a) {
    const double square = a.squaredNorm(), angle = std::sqrt(square);
    const double sine = angle < 1e-4 ? 1.0 - square / 6.0 : std::sin(angle) / angle;
    const double cosine = angle < 1e-4 ? 0.5 - square / 24.0 : (1.0 - std::cos(angle)) / square;
    const Matrix3d S = skew(a);
    return Matrix3d::Identity() + sine * S + cosine * S * S;
}

Vector3d log_rotation(const Matrix3d& R) {
    const Eigen::AngleAxisd turn(R);
    return turn.angle() * turn.axis();
}

Matrix3d right_jacobian(const Vector3d& a) {
    const double square = a.squaredNorm(), angle = std::sqrt(square);
    const double once = angle < 1e-4 ? 0.5 - square / 24.0 : (1.0 - std::cos(angle)) / square;
    const double twice = angle < 1e-4 ? 1.0 / 6.0 - square / 120.0 : (angle - std::sin(angle)) / (square * angle);
    const Matrix3d S = skew(a);
    return Matrix3d::Identity() - once * S + twice * S * S;
}

Matrix3d from_rpy(double roll, double pitch, double yaw) {
    using Eigen::AngleAxisd;
    return (AngleAxisd(yaw, Vector3d::UnitZ()) * AngleAxisd(pitch, Vector3d::UnitY()) *
            AngleAxisd(roll, Vector3d::UnitX())).toRotationMatrix();
}

double wrap(double angle) { return std::remainder(angle, 2.0 * M_PI); }

// ---- the log ---------------------------------------------------------------------------------------------------

struct Sample { double time; Vector3d force, rate, field; };  // force and rate in b, field in the IMU's axes
struct Ping { double time; Vector3d velocity; double heading; };
struct Depth { double time, depth; };
struct Log { std::vector<Sample> samples; std::vector<Ping> pings; std::vector<Depth> depths; };

Log read_log(const char* path) {
    FILE* file = std::fopen(path, "rb");
    if (!file) { std::perror(path); std::exit(1); }
    std::fseek(file, 0, SEEK_END);
    std::string text(std::ftell(file), '\0');
    std::rewind(file);
    if (std::fread(text.data(), 1, text.size(), file) != text.size()) std::exit(1);
    std::fclose(file);
    static const char* names[] = {"time", "acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z", "mag_x", "mag_y",
                                  "mag_z", "dvl_vx", "dvl_vy", "dvl_vz", "dvl_valid", "dvl_heading", "depth"};
    const char *at = text.data(), *end = at + text.size();
    for (const char* name : names) {  // the columns that the shipped dive has, in their order
        if (std::strncmp(at, name, std::strlen(name))) { std::fprintf(stderr, "no column %s\n", name); std::exit(1); }
        at += std::strlen(name) + 1;
    }
    Log log;
    const Matrix3d R_bs = from_rpy(config::imu_rpy.x(), config::imu_rpy.y(), config::imu_rpy.z());
    double cell[16];
    while (at < end && *at != '\r' && *at != '\n') {
        for (double& value : cell) {
            value = NAN;
            if (*at != ',' && *at != '\n') at = std::from_chars(at, end, value).ptr;
            ++at;
        }
        const Eigen::Map<Vector3d> force(cell + 1), rate(cell + 4), field(cell + 7), velocity(cell + 10);
        if (!std::isnan(cell[1])) log.samples.push_back({cell[0], R_bs * force, R_bs * rate, field});
        if (cell[13] == 1.0 && velocity.cwiseAbs().maxCoeff() < config::max_speed)
            log.pings.push_back({cell[0], velocity, cell[14]});
        if (!std::isnan(cell[15])) log.depths.push_back({cell[0], cell[15]});
    }
    return log;
}

// ---- what is constant while iterating --------------------------------------------------------------------------

struct Motion {  // of the IMU from a keyframe on, for no bias, with derivatives by the biases
    double t = 0.0;
    Matrix3d R = Matrix3d::Identity(), R_gyr = Matrix3d::Zero();
    Vector3d v = Vector3d::Zero(), p = Vector3d::Zero();
    Matrix3d v_acc = Matrix3d::Zero(), v_gyr = Matrix3d::Zero(), p_acc = Matrix3d::Zero(), p_gyr = Matrix3d::Zero();
    Eigen::Matrix<double, 9, 9> covariance = Eigen::Matrix<double, 9, 9>::Zero();  // of rotation, p, v
    Eigen::Matrix<double, STATE, STATE> W;                                         // square-root information

    void step(const Vector3d& a, const Vector3d& w, double dt) {
        const Matrix3d turn = exp_rotation(w * dt), Jr = right_jacobian(w * dt), Ra = R * skew(a);
        Eigen::Matrix<double, 9, 9> F = Eigen::Matrix<double, 9, 9>::Identity();
        F.block<3, 3>(THETA, THETA) = turn.transpose();
        F.block<3, 3>(P, THETA) = -0.5 * dt * dt * Ra;
        F.block<3, 3>(P, V) = dt * Matrix3d::Identity();
        F.block<3, 3>(V, THETA) = -dt * Ra;
        covariance = (F * covariance * F.transpose()).eval();
        covariance.block<3, 3>(THETA, THETA) += config::gyr_noise * config::gyr_noise * dt * Jr * Jr.transpose();
        const double acc = config::acc_noise * config::acc_noise * dt;
        covariance.block<3, 3>(V, V).diagonal().array() += acc;
        covariance.block<3, 3>(P, V).diagonal().array() += 0.5 * dt * acc;
        covariance.block<3, 3>(V, P).diagonal().array() += 0.5 * dt * acc;
        covariance.block<3, 3>(P, P).diagonal().array() += 0.25 * dt * dt * acc + 1e-14;
        p_acc += dt * v_acc - 0.5 * dt * dt * R;
        p_gyr += dt * v_gyr - 0.5 * dt * dt * Ra * R_gyr;
        v_acc -= dt * R;
        v_gyr -= dt * Ra * R_gyr;
        p += dt * v + 0.5 * dt * dt * (R * a);
        v += dt * (R * a);
        R_gyr = turn.transpose() * R_gyr - dt * Jr;
        R = R * turn;
        t += dt;
    }

    void finish() {
        Eigen::Matrix<double, STATE, STATE> S = Eigen::Matrix<double, STATE, STATE>::Zero();
        S.topLeftCorner<9, 9>() = covariance;
        for (int i = 0; i < 3; ++i) {
            S(ACC + i, ACC + i) = config::acc_walk * config::acc_walk * t;
            S(GYR + i, GYR + i) = config::gyr_walk * config::gyr_walk * t;
        }
        W.setIdentity();
        S.llt().matrixL().solveInPlace(W);
    }
};

enum Kind { DVL, COMPASS, MAGNETOMETER, DEPTH };
const double HUBER[] = {2.795, 1.960, 2.795, 1.960};  // where 95 % of good measurements lie below

struct Measurement {
    Kind kind;
    int dim;
    Vector3d z, rate;  // rate in b
    Matrix3d W;        // lower triangle of the square-root information
    double t;          // since the keyframe
    Matrix3d R;        // turned since then
    Vector3d v, p;     // of the motion since then
};

struct Dive {
    std::vector<double> times;
    std::vector<Vector3d> rates;               // at keyframes, in b
    std::vector<Motion> motions;               // to the next keyframe
    std::vector<Measurement> measurements;
    std::vector<int> first;                    // of each keyframe
};

struct Signal {  // of the IMU, linear between samples
    const std::vector<Sample>& samples;
    size_t at = 0;

    // from one time to another; calls at each measurement's time between them
    template <class Stop>
    void integrate(Motion& motion, double from, double to, const std::vector<double>& stops, Stop stopped) {
        double now = from;
        size_t stop = 0;
        while (now < to - 1e-9) {
            while (at + 1 < samples.size() && samples[at + 1].time <= now + 1e-9) ++at;
            double then = at + 1 < samples.size() ? std::min(to, samples[at + 1].time) : to;
            if (stop < stops.size()) then = std::min(then, stops[stop]);
            if (then > now) {
                const Sample &a = samples[at], &b = samples[std::min(at + 1, samples.size() - 1)];
                const double share = b.time > a.time ? (0.5 * (now + then) - a.time) / (b.time - a.time) : 0.0;
                const Vector3d w = a.rate + share * (b.rate - a.rate), f = a.force + share * (b.force - a.force);
                const double dt = then - now;
                motion.step(f + 0.5 * dt * w.cross(f), w, dt);
            }
            now = then;
            for (; stop < stops.size() && stops[stop] <= now + 1e-9; ++stop) stopped(stop);
        }
    }

    // the mean within a tenth of a second of a time
    Vector3d rate(double time) const {
        Vector3d sum = Vector3d::Zero();
        size_t k = at;
        while (k > 0 && samples[k].time > time - 0.1) --k;
        int count = 0;
        for (; k < samples.size() && samples[k].time < time + 0.1; ++k)
            if (samples[k].time > time - 0.1) sum += samples[k].rate, ++count;
        return count ? Vector3d(sum / count) : samples[std::min(k, samples.size() - 1)].rate;
    }
};

Measurement measurement(Kind kind, int dim, const Vector3d& z, const Vector3d& sd) {
    Measurement m{kind, dim, z, Vector3d::Zero(), Matrix3d::Zero(), 0.0, Matrix3d::Identity()};
    m.v = m.p = Vector3d::Zero();
    m.W.diagonal() = sd.cwiseInverse();
    return m;
}

// Keyframes at pings and at the first and the last sample; between them one sample of field and depth each, at their
// own times. A ping within 50 ms of another keyframe, which rovgraph carries there, is left out: it is one of 2690.
Dive assemble(const Log& log) {
    Dive dive;
    std::vector<const Ping*> pings{nullptr};
    dive.times.push_back(log.samples[0].time);
    for (const Ping& ping : log.pings)
        if (ping.time - dive.times.back() >= config::shortest) dive.times.push_back(ping.time), pings.push_back(&ping);
    if (log.samples.back().time > dive.times.back() + 1e-6)
        dive.times.push_back(log.samples.back().time), pings.push_back(nullptr);
    Signal signal{log.samples};
    const Vector3d field_sd = Vector3d::Constant(config::mag_sd), depth_sd = Vector3d::Constant(config::depth_sd);
    const Matrix3d to_dvl = from_rpy(config::dvl_rpy.x(), config::dvl_rpy.y(), config::dvl_rpy.z()).transpose();
    const Matrix3d gain = to_dvl * skew(config::dvl_arm - config::imu_arm);
    const double rate_sd = config::gyr_noise * 10.0 / std::sqrt(20.0);  // of the mean of twenty samples at 100 Hz
    Matrix3d dvl_S = rate_sd * rate_sd * gain * gain.transpose();
    dvl_S.diagonal() += config::dvl_sd.cwiseAbs2();
    Matrix3d dvl_W = Matrix3d::Identity();
    dvl_S.llt().matrixL().solveInPlace(dvl_W);
    size_t depth = 0, field = 0;
    for (size_t k = 0; k < dive.times.size(); ++k) {
        const double time = dive.times[k];
        dive.first.push_back(dive.measurements.size());
        dive.rates.push_back(signal.rate(time));
        if (pings[k]) {
            Measurement m = measurement(DVL, 3, pings[k]->velocity, config::dvl_sd);
            m.W = dvl_W, m.rate = dive.rates.back();
            dive.measurements.push_back(m);
            const Vector3d heading(pings[k]->heading, 0, 0);
            dive.measurements.push_back(measurement(COMPASS, 1, heading, Vector3d::Constant(config::heading_sd)));
        }
        if (k + 1 == dive.times.size()) break;
        std::vector<double> stops;
        std::vector<Measurement> between;
        while (field < log.samples.size() && log.samples[field].time < time) ++field;
        while (depth < log.depths.size() && log.depths[depth].time < time) ++depth;
        if (field < log.samples.size() && log.samples[field].time < dive.times[k + 1]) {
            between.push_back(measurement(MAGNETOMETER, 3, log.samples[field].field, field_sd));
            stops.push_back(log.samples[field].time);
        }
        if (depth < log.depths.size() && log.depths[depth].time < dive.times[k + 1]) {
            between.push_back(measurement(DEPTH, 1, Vector3d(log.depths[depth].depth, 0, 0), depth_sd));
            stops.push_back(log.depths[depth].time);
        }
        if (stops.size() == 2 && stops[1] < stops[0]) std::swap(stops[0], stops[1]), std::swap(between[0], between[1]);
        Motion motion;
        signal.integrate(motion, time, dive.times[k + 1], stops, [&](size_t stop) {
            Measurement& m = between[stop];
            m.t = motion.t, m.R = motion.R, m.v = motion.v, m.p = motion.p;
        });
        motion.finish();
        dive.motions.push_back(motion);
        dive.measurements.insert(dive.measurements.end(), between.begin(), between.end());
    }
    dive.first.push_back(dive.measurements.size());
    return dive;
}

// ---- state and equations ---------------------------------------------------------------------------------------

struct Keyframe { Matrix3d R; Vector3d p, v; Vector6d bias; };
struct Point { std::vector<Keyframe> keyframes; Eigen::Matrix<double, CONSTANTS, 1> c; };

Matrix3d mount_of_dvl(const Point& x) {
    return from_rpy(config::dvl_rpy.x(), config::dvl_rpy.y(), config::dvl_rpy.z() + x.c[YAW]);
}

// Heading of an axis of the body; a rotation d of the body changes it by gradient . d
double heading_of(const Matrix3d& R, const Vector3d& axis, Vector3d& gradient) {
    const Vector3d u = R * axis;
    const Vector3d by_u(-u.y(), u.x(), 0);
    gradient = axis.cross(R.transpose() * by_u) / (u.x() * u.x() + u.y() * u.y());
    return std::atan2(u.y(), u.x());
}

// Whitened rows of a measurement: columns of the keyframe in H, of the constants and the residual in B
double linearise(const Measurement& m, const Keyframe& x, const Point& point, const Matrix3d& R_bs,
                 Eigen::Ref<Rows> H, Eigen::Ref<Rows> B) {
    static const Matrix3d R_imu = from_rpy(config::imu_rpy.x(), config::imu_rpy.y(), config::imu_rpy.z());
    const auto& c = point.c;
    const Vector3d acc = x.bias.head<3>(), gyr = x.bias.tail<3>();
    const Matrix3d R_since = m.R * exp_rotation(-m.t * gyr), R = x.R * R_since;
    Vector3d z = Vector3d::Zero();
    Eigen::Matrix<double, 3, 3, Eigen::RowMajor> by_turn = Matrix3d::Zero();
    H.setZero(), B.setZero();
    if (m.kind == DVL) {
        const Vector3d arm = config::dvl_arm - config::imu_arm, body = R.transpose() * x.v;
        const Vector3d v_b = body + (m.rate - gyr).cross(arm);
        const Matrix3d to = R_bs.transpose();
        z = to * v_b;
        by_turn = to * skew(body);
        H.block<3, 3>(0, V) = to * R.transpose();
        H.block<3, 3>(0, GYR) = to * skew(arm);
        B.block<3, 1>(0, YAW) = to * v_b.cross(Vector3d::UnitZ());
    } else if (m.kind == COMPASS) {
        Vector3d gradient;
        const double heading = heading_of(R, R_bs.col(0), gradient) - config::declination;
        const double sine = std::sin(heading), cosine = std::cos(heading);
        z[0] = heading + c[OFFSET] + c[DEVIATION] * sine + c[DEVIATION + 1] * cosine;
        gradient *= 1.0 + c[DEVIATION] * cosine - c[DEVIATION + 1] * sine;
        by_turn.row(0) = gradient;
        B(0, YAW) = gradient.z(), B(0, OFFSET) = 1.0, B(0, DEVIATION) = sine, B(0, DEVIATION + 1) = cosine;
    } else if (m.kind == MAGNETOMETER) {
        const double dip = config::dip + c[DIP], d = config::declination;
        const Vector3d u(std::cos(dip) * std::cos(d), std::cos(dip) * std::sin(d), std::sin(dip));
        const Vector3d by_dip(-std::sin(dip) * std::cos(d), -std::sin(dip) * std::sin(d), std::cos(dip));
        const Vector3d u_b = R.transpose() * u;
        const Matrix3d to = (1.0 + c[FIELD]) * R_imu.transpose();
        z = to * u_b + c.segment<3>(IRON);
        by_turn = to * skew(u_b);
        B.block<3, 3>(0, IRON).setIdentity();
        B.block<3, 1>(0, DIP) = to * (R.transpose() * by_dip);
        B.block<3, 1>(0, FIELD) = to * u_b / (1.0 + c[FIELD]);
    } else {
        const double t = m.t;
        const Vector3d p = x.p + t * x.v + x.R * (m.p - 0.5 * t * t * acc);
        const Vector3d arm = -config::imu_arm, row = R.row(2);
        z[0] = p.z() + 0.5 * config::gravity * t * t + row.dot(arm);
        by_turn.row(0) = arm.cross(row);
        H.block<1, 3>(0, THETA) = (m.p - 0.5 * t * t * acc).cross(Vector3d(x.R.row(2))).transpose();
        H(0, P + 2) = 1.0, H(0, V + 2) = t;
        H.block<1, 3>(0, ACC) = -0.5 * t * t * x.R.row(2);
    }
    const int n = m.dim;
    H.block(0, THETA, n, 3) += by_turn.topRows(n) * R_since.transpose();
    H.block(0, GYR, n, 3) -= m.t * by_turn.topRows(n);
    Vector3d r = m.z - z;
    if (m.kind == COMPASS) r[0] = wrap(r[0]);
    B.col(CONSTANTS) = r.head(n);
    for (int row = n - 1; row >= 0; --row) {
        H.row(row) *= m.W(row, row), B.row(row) *= m.W(row, row);
        for (int k = 0; k < row; ++k) H.row(row) += m.W(row, k) * H.row(k), B.row(row) += m.W(row, k) * B.row(k);
    }
    return B.col(CONSTANTS).norm();
}

// Whitened rows of a motion: columns of the keyframe before, of that after, and of the border
void linearise(const Motion& m, const Keyframe& i, const Keyframe& j, Conditional& A) {
    const Vector3d g(0, 0, config::gravity), acc = i.bias.head<3>(), gyr = i.bias.tail<3>();
    const Matrix3d back = i.R.transpose(), R = m.R * exp_rotation(m.R_gyr * gyr);
    const Vector3d r = log_rotation(R.transpose() * back * j.R);
    const Vector3d dv = back * (j.v - i.v - m.t * g), dp = back * (j.p - i.p - m.t * i.v - 0.5 * m.t * m.t * g);
    const Matrix3d inverse = right_jacobian(r).inverse();
    A.setZero();
    A.block<3, 3>(THETA, THETA) = -inverse * j.R.transpose() * i.R;
    A.block<3, 3>(THETA, GYR) = -inverse * exp_rotation(r).transpose() * right_jacobian(m.R_gyr * gyr) * m.R_gyr;
    A.block<3, 3>(THETA, STATE + THETA) = inverse;
    A.block<3, 3>(P, THETA) = skew(dp);
    A.block<3, 3>(P, P) = -back;
    A.block<3, 3>(P, V) = -m.t * back;
    A.block<3, 3>(P, ACC) = -m.p_acc;
    A.block<3, 3>(P, GYR) = -m.p_gyr;
    A.block<3, 3>(P, STATE + P) = back;
    A.block<3, 3>(V, THETA) = skew(dv);
    A.block<3, 3>(V, V) = -back;
    A.block<3, 3>(V, ACC) = -m.v_acc;
    A.block<3, 3>(V, GYR) = -m.v_gyr;
    A.block<3, 3>(V, STATE + V) = back;
    A.block<6, 6>(ACC, ACC) = -Eigen::Matrix<double, 6, 6>::Identity();
    A.block<6, 6>(ACC, STATE + ACC).setIdentity();
    A.block<3, 1>(THETA, WIDTH - 1) = -r;
    A.block<3, 1>(P, WIDTH - 1) = -(dp - m.p - m.p_acc * acc - m.p_gyr * gyr);
    A.block<3, 1>(V, WIDTH - 1) = -(dv - m.v - m.v_acc * acc - m.v_gyr * gyr);
    A.block<6, 1>(ACC, WIDTH - 1) = i.bias - j.bias;
    for (int row = ACC - 1; row >= 0; --row) {
        A.row(row) *= m.W(row, row);
        for (int k = 0; k < row; ++k) A.row(row) += m.W(row, k) * A.row(k);
    }
    for (int k = ACC; k < STATE; ++k) A.row(k) *= m.W(k, k);
}

// ---- elimination -----------------------------------------------------------------------------------------------

// Householder reflections that clear columns [from, to) of some rows against those of a triangle, all of WIDE columns.
// Row `from` of the triangle is at `triangle`.
template <int WIDE>
void absorb(double* triangle, double* rows, int count, int from, int to) {
    double w[WIDE];
    for (int j = from; j < to; ++j, triangle += WIDE) {
        double square = 0.0;
        for (int i = 0; i < count; ++i) square += rows[i * WIDE + j] * rows[i * WIDE + j];
        if (square == 0.0) continue;
        const double head = triangle[j], length = std::copysign(std::sqrt(head * head + square), head);
        const double scale = 1.0 / (head + length), tau = (head + length) / length;
        for (int c = j + 1; c < WIDE; ++c) w[c] = triangle[c];
        for (int i = 0; i < count; ++i) {
            double* row = rows + i * WIDE;
            row[j] *= scale;
            for (int c = j + 1; c < WIDE; ++c) w[c] += row[j] * row[c];
        }
        for (int c = j + 1; c < WIDE; ++c) w[c] *= tau, triangle[c] -= w[c];
        triangle[j] = -length;
        for (int i = 0; i < count; ++i) {
            double* row = rows + i * WIDE;
            for (int c = j + 1; c < WIDE; ++c) row[c] -= row[j] * w[c];
        }
    }
}

struct Elimination {
    std::vector<Conditional> conditionals;                               // of each keyframe
    Eigen::Matrix<double, CONSTANTS, BORDER, Eigen::RowMajor> border;  // triangle of the constants, right-hand side
};

bool entered(double length, int round) { return round < 2 || length <= config::gate_sd; }

void eliminate(const Dive& dive, const Point& x, const Point& prior, int round, Elimination& out) {
    const int n = dive.times.size();
    const Matrix3d mount = mount_of_dvl(x);
    out.conditionals.resize(n);
    out.border.setZero();
    for (int j = 0; j < CONSTANTS; ++j) {
        out.border(j, j) = 1.0 / config::constant_sd[j];
        out.border(j, CONSTANTS) = -x.c[j] / config::constant_sd[j];
    }
    constexpr int OWN = STATE + BORDER;
    Eigen::Matrix<double, STATE, OWN, Eigen::RowMajor> carried, measured;
    carried.setZero();
    Conditional A;
    double behind[STATE * BORDER];
    const Keyframe &first = x.keyframes[0], &before = prior.keyframes[0];
    Eigen::Matrix<double, STATE, 1> error, sd;
    error << log_rotation(first.R.transpose() * before.R), before.p - first.p, before.v - first.v,
        before.bias - first.bias;
    sd << config::tilt_sd, config::tilt_sd, config::start_heading_sd, config::start_sd, config::start_sd,
        config::start_down_sd, Vector3d::Constant(config::start_velocity_sd), Vector3d::Constant(config::acc_bias_sd),
        Vector3d::Constant(config::gyr_bias_sd);
    carried.leftCols<STATE>().diagonal() = sd.cwiseInverse();
    carried.col(STATE + CONSTANTS) = error.cwiseQuotient(sd);
    for (int k = 0; k < n; ++k) {
        int rows = 0;
        for (int m = dive.first[k]; m < dive.first[k + 1]; ++m) {
            const Measurement& z = dive.measurements[m];
            auto block = measured.middleRows(rows, z.dim);
            const double length =
                linearise(z, x.keyframes[k], x, mount, block.leftCols(STATE), block.rightCols(BORDER));
            if (!entered(length, round)) continue;
            const double bend = HUBER[z.kind];
            if (length > bend) block *= std::sqrt(bend / length);
            rows += z.dim;
        }
        absorb<OWN>(carried.data(), measured.data(), rows, 0, STATE);
        Eigen::Map<Eigen::Matrix<double, STATE, BORDER, Eigen::RowMajor>>{behind} = measured.rightCols<BORDER>();
        absorb<BORDER>(out.border.data(), behind, rows, 0, CONSTANTS);
        Conditional& conditional = out.conditionals[k];
        conditional.leftCols<STATE>() = carried.leftCols<STATE>();
        conditional.middleCols<STATE>(STATE).setZero();
        conditional.rightCols<BORDER>() = carried.rightCols<BORDER>();
        if (k + 1 == n) break;
        linearise(dive.motions[k], x.keyframes[k], x.keyframes[k + 1], A);
        absorb<WIDTH>(conditional.data(), A.data(), ACC, 0, ACC);  // the biases' rows begin with theirs
        absorb<WIDTH>(conditional.row(ACC).data(), A.data(), STATE, ACC, STATE);
        carried = A.rightCols<OWN>();
        for (int j = 0; j + 1 < STATE; ++j)  // to a triangle again
            absorb<OWN>(carried.row(j).data(), carried.row(j + 1).data(), STATE - 1 - j, j, j + 1);
    }
}

// The step of Gauss-Newton; returns the farthest that a keyframe moves [m]
double move(Point& x, const Elimination& e) {
    const int n = x.keyframes.size();
    Eigen::Matrix<double, CONSTANTS, 1> c = e.border.col(CONSTANTS);
    e.border.leftCols<CONSTANTS>().triangularView<Eigen::Upper>().solveInPlace(c);
    Eigen::Matrix<double, STATE, 1> d, next = Eigen::Matrix<double, STATE, 1>::Zero();
    double largest = 0.0;
    for (int k = n - 1; k >= 0; --k) {
        const Conditional& r = e.conditionals[k];
        d = r.col(WIDTH - 1) - r.middleCols<STATE>(STATE) * next - r.middleCols<CONSTANTS>(2 * STATE) * c;
        r.leftCols<STATE>().triangularView<Eigen::Upper>().solveInPlace(d);
        Keyframe& f = x.keyframes[k];
        f.R = f.R * exp_rotation(d.head<3>());
        f.p += d.segment<3>(P), f.v += d.segment<3>(V), f.bias += d.tail<6>();
        largest = std::max(largest, d.segment<3>(P).norm());
        next = d;
    }
    x.c += c;
    return largest;
}

// Covariance of each keyframe, shape (15, 15)
std::vector<Eigen::Matrix<double, STATE, STATE>> covariances(const Elimination& e) {
    constexpr int C = CONSTANTS;
    const int n = e.conditionals.size();
    std::vector<Eigen::Matrix<double, STATE, STATE>> out(n);
    Eigen::Matrix<double, C, C> root = Eigen::Matrix<double, C, C>::Identity();
    e.border.leftCols<C>().triangularView<Eigen::Upper>().solveInPlace(root);
    Eigen::Matrix<double, STATE + C, STATE + C> joint;  // of the next keyframe and the constants
    joint.setZero();
    joint.bottomRightCorner<C, C>() = root * root.transpose();
    Eigen::Matrix<double, STATE, STATE> inverse;
    Eigen::Matrix<double, STATE, STATE + C> G, GP;
    for (int k = n - 1; k >= 0; --k) {
        const Conditional& r = e.conditionals[k];
        const auto R = r.leftCols<STATE>().triangularView<Eigen::Upper>();
        inverse.setIdentity();
        R.solveInPlace(inverse);
        G.noalias() = -inverse * r.middleCols<STATE + C>(STATE);
        GP.noalias() = G * joint;
        out[k].noalias() = inverse * inverse.transpose();
        out[k].noalias() += GP * G.transpose();
        joint.topLeftCorner<STATE, STATE>() = out[k];
        joint.topRightCorner<STATE, C>() = GP.rightCols<C>();
        joint.bottomLeftCorner<C, STATE>() = GP.rightCols<C>().transpose();
    }
    return out;
}

// ---- to begin with, and what is written ------------------------------------------------------------------------

// Tilt by the specific force of 2 s, heading by the field, velocity by the pings' median of five, and their sum
Point start_of(const Log& log, const Dive& dive) {
    Point x;
    x.c.setZero();
    const Matrix3d R_imu = from_rpy(config::imu_rpy.x(), config::imu_rpy.y(), config::imu_rpy.z());
    const Matrix3d R_dvl = from_rpy(config::dvl_rpy.x(), config::dvl_rpy.y(), config::dvl_rpy.z());
    std::vector<Vector3d> sums(log.samples.size() + 1, Vector3d::Zero()), fields = sums;
    for (size_t k = 0; k < log.samples.size(); ++k) {
        sums[k + 1] = sums[k] + log.samples[k].force;
        fields[k + 1] = fields[k] + R_imu * log.samples[k].field;
    }
    const int samples = log.samples.size(), pings = log.pings.size();
    auto index = [&](double time) {
        return int(std::lower_bound(log.samples.begin(), log.samples.end(), time,
                                    [](const Sample& s, double t) { return s.time < t; }) - log.samples.begin());
    };
    for (int k = 0; k < int(dive.times.size()); ++k) {
        const int at = index(dive.times[k]), low = std::max(at - 100, 0), high = std::min(at + 100, samples);
        const Vector3d down = -(sums[high] - sums[low]).normalized();
        const int near = std::max(at - 5, 0), after = std::min(at + 5, samples);
        const Vector3d east = down.cross(fields[after] - fields[near]).normalized(), north = east.cross(down);
        Keyframe f;
        Matrix3d magnetic;
        magnetic.row(0) = north, magnetic.row(1) = east, magnetic.row(2) = down;
        f.R = from_rpy(0, 0, config::declination) * magnetic;
        Vector3d velocity;
        const int from = std::clamp(k - 2, 0, std::max(pings - 5, 0));
        for (int i = 0; i < 3; ++i) {
            double five[5];
            for (int j = 0; j < 5; ++j) five[j] = log.pings[from + j].velocity[i];
            std::nth_element(five, five + 2, five + 5);
            velocity[i] = five[2];
        }
        f.v = f.R * (R_dvl * velocity);
        f.bias.setZero();
        if (k == 0) f.p = f.R * config::imu_arm, f.p.z() += log.depths[0].depth;
        else f.p = x.keyframes.back().p + 0.5 * (dive.times[k] - dive.times[k - 1]) * (x.keyframes.back().v + f.v);
        x.keyframes.push_back(f);
    }
    return x;
}

void write(const char* path, const Dive& dive, const Point& x,
           const std::vector<Eigen::Matrix<double, STATE, STATE>>& covariance) {
    std::string text =
        "time,north,east,down,roll,pitch,yaw,v_north,v_east,v_down,north_sd,east_sd,down_sd,roll_sd,pitch_sd,yaw_sd,"
        "v_north_sd,v_east_sd,v_down_sd\n";
    text.reserve(220 * dive.times.size());
    char number[32];
    auto put = [&](double value, char behind, int digits = 6) {
        const auto end = std::to_chars(number, number + 32, value, std::chars_format::fixed, digits).ptr;
        text.append(number, end).push_back(behind);
    };
    for (size_t k = 0; k < dive.times.size(); ++k) {
        const Keyframe& f = x.keyframes[k];
        const Matrix3d arm = f.R * skew(config::imu_arm);
        Eigen::Matrix<double, 9, STATE> J = Eigen::Matrix<double, 9, STATE>::Zero();  // position, angles in n, velocity
        J.block<3, 3>(0, THETA) = arm;
        J.block<3, 3>(0, P).setIdentity();
        J.block<3, 3>(3, THETA) = f.R;
        J.block<3, 3>(6, V).setIdentity();
        const Vector3d p = f.p - f.R * config::imu_arm;
        const Vector3d v = f.v - f.R * (dive.rates[k] - f.bias.tail<3>()).cross(config::imu_arm);
        const Eigen::Matrix<double, 9, 1> sd = (J * covariance[k] * J.transpose()).diagonal().cwiseSqrt();
        put(dive.times[k], ',');
        for (int i = 0; i < 3; ++i) put(p[i], ',');
        put(std::atan2(f.R(2, 1), f.R(2, 2)), ',');
        put(-std::asin(std::clamp(f.R(2, 0), -1.0, 1.0)), ',');
        put(std::atan2(f.R(1, 0), f.R(0, 0)), ',');
        for (int i = 0; i < 3; ++i) put(v[i], ',');
        for (int i = 0; i < 9; ++i) put(sd[i], i < 8 ? ',' : '\n');
    }
    FILE* file = std::fopen(path, "wb");
    if (!file || std::fwrite(text.data(), 1, text.size(), file) != text.size()) { std::perror(path); std::exit(1); }
    std::fclose(file);
}

int main(int argc, char** argv) {
    if (argc < 3) { std::fprintf(stderr, "estimate LOG.csv TRAJECTORY.csv [ITERATIONS]\n"); return 2; }
    const int iterations = argc > 3 ? std::atoi(argv[3]) : 6;
    std::clock_t began = std::clock();
    auto passed = [&](const char* stage) {
        const std::clock_t now = std::clock();
        std::printf("%s %.0f ms, ", stage, 1e3 * double(now - began) / CLOCKS_PER_SEC);
        began = now;
    };
    const Log log = read_log(argv[1]);
    passed("read");
    const Dive dive = assemble(log);
    Point x = start_of(log, dive);
    passed("assemble");
    const Point prior = x;
    Elimination e;
    for (int round = 0; round < iterations; ++round) {
        eliminate(dive, x, prior, round, e);
        std::fprintf(stderr, "step %d: %.4f m\n", round + 1, move(x, e));
    }
    passed("iterate");
    eliminate(dive, x, prior, iterations, e);  // at the optimum
    const auto covariance = covariances(e);
    passed("covariances");
    write(argv[2], dive, x, covariance);
    passed("write");
    std::printf("%zu keyframes, %zu measurements\n", dive.times.size(), dive.measurements.size());
}
