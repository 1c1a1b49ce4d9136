// A ROS 2 node as eProsima's Fast DDS makes it, without ROS: prints what it receives, sends messages.
//
//     node DOMAIN [--any] TOPIC... [TOPIC=TYPE]... [--control STATES COMMANDS KP KD GOAL...]
//
// On standard output one JSON array a line: ["message", topic, time in ns, fields] of what comes,
// ["sent", topic, time in ns] of what goes, ["matched", topic, change of the number of others], and
// ["writer", DDS topic, DDS type, user data] of the writers of others. TOPICs of known names are
// listened to, others are for points; of TOPIC=TYPE are listened to "state" (JointState) and
// "clock", and talked on "command" (JointState), "bool" and "uint". Lines of standard input are
// sent; its end ends the program:
//
//     TOPIC FRAME X Y Z                                    a point, "-" is an empty frame
//     TOPIC VALUE                                          bool and uint
//     TOPIC TIMES STAMP NAMES POSITIONS VELOCITIES EFFORTS command; lists a,b,c or "-"; stamp in ns
//
// With --control it is a controller too, which answers each state at once with the efforts
// KP (goal - q) - KD v, joints in reverse order, stamped as the state; ["controlled", count] at its
// end. Stays on the loopback interface unless --any.

#include <chrono>
#include <cstdio>
#include <iostream>
#include <map>
#include <memory>
#include <mutex>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/domain/DomainParticipantListener.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/DataWriterListener.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>

#include "rosPubSubTypes.h"

using namespace eprosima::fastdds::dds;
using namespace eprosima::fastdds::rtps;
using eprosima::fastrtps::rtps::WriterDiscoveryInfo;
using builtin_interfaces::msg::dds_::Time_;
using geometry_msgs::msg::dds_::PointStamped_;
using geometry_msgs::msg::dds_::TransformStamped_;
using sensor_msgs::msg::dds_::JointState_;
using rosgraph_msgs::msg::dds_::Clock_;
using std_msgs::msg::dds_::Bool_;
using std_msgs::msg::dds_::Header_;
using std_msgs::msg::dds_::UInt32_;
using std_msgs::msg::dds_::String_;
using tf2_msgs::msg::dds_::TFMessage_;

static std::mutex printing;

static void print(const std::string& line) {
    std::lock_guard<std::mutex> lock(printing);
    std::cout << line << std::endl;
}

static std::string now() {
    auto time = std::chrono::system_clock::now().time_since_epoch();
    return std::to_string(std::chrono::duration_cast<std::chrono::nanoseconds>(time).count());
}

static std::string json(const TransformStamped_& it);

static std::string json(double value) {
    char text[40];  // NaN and Infinity as Python's json reads them
    if (value != value) return "NaN";
    if (value - value != 0) return value > 0 ? "Infinity" : "-Infinity";
    std::snprintf(text, sizeof text, "%.17g", value);
    return text;
}

static std::string json(const std::string& text) {
    std::string quoted = "\"";
    for (unsigned char c : text) {
        char code[8];
        std::snprintf(code, sizeof code, c < ' ' || c == '"' || c == '\\' ? "\\u%04x" : "%c", c);
        quoted += code;
    }
    return quoted + '"';
}

template <class T>
static std::string json(const std::vector<T>& values) {
    std::string list;
    for (const T& value : values) list += (list.empty() ? "" : ",") + json(value);
    return "[" + list + "]";
}

static std::string json(const Header_& header) {
    const Time_& stamp = header.stamp_();
    return "[[" + std::to_string(stamp.sec_()) + "," + std::to_string(stamp.nanosec_()) + "]," +
           json(header.frame_id_()) + "]";
}

static std::string json(const JointState_& state) {
    return "[" + json(state.header_()) + "," + json(state.name_()) + "," +
           json(state.position_()) + "," + json(state.velocity_()) + "," + json(state.effort_()) +
           "]";
}

static std::string json(const PointStamped_& it) {
    const auto& p = it.point_();
    return "[" + json(it.header_()) + "," + json(std::vector<double>{p.x_(), p.y_(), p.z_()}) + "]";
}

static std::string json(const TransformStamped_& it) {
    const auto& p = it.transform_().translation_();
    const auto& r = it.transform_().rotation_();
    return "[" + json(it.header_()) + "," + json(it.child_frame_id_()) + ",[" +
           json(std::vector<double>{p.x_(), p.y_(), p.z_()}) + "," +
           json(std::vector<double>{r.x_(), r.y_(), r.z_(), r.w_()}) + "]]";
}

static std::string json(const Clock_& it) {
    return "[" + std::to_string(it.clock_().sec_()) + "," + std::to_string(it.clock_().nanosec_()) +
           "]";
}

static std::string json(const TFMessage_& it) { return "[" + json(it.transforms_()) + "]"; }
static std::string json(const String_& it) { return "[" + json(it.data_()) + "]"; }

static void matched(const std::string& topic, int change) {
    print("[\"matched\"," + json(topic) + "," + std::to_string(change) + "]");
}

template <class T>
class Printer : public DataReaderListener {
public:
    explicit Printer(const std::string& topic) : topic_(topic) {}

    void on_data_available(DataReader* reader) override {
        T message;
        SampleInfo info;
        while (reader->take_next_sample(&message, &info) == ReturnCode_t::RETCODE_OK) {
            if (info.valid_data)
                print("[\"message\"," + json(topic_) + "," + now() + "," + json(message) + "]");
        }
    }

    void on_subscription_matched(DataReader*, const SubscriptionMatchedStatus& status) override {
        matched(topic_, status.current_count_change);
    }

private:
    std::string topic_;
};

class Matched : public DataWriterListener {
public:
    explicit Matched(const std::string& topic) : topic_(topic) {}

    void on_publication_matched(DataWriter*, const PublicationMatchedStatus& status) override {
        matched(topic_, status.current_count_change);
    }

private:
    std::string topic_;
};

class Controller : public DataReaderListener {
public:
    Controller(DataWriter* commands, std::vector<double> numbers)
        : commands_(commands), kp_(numbers[0]), kd_(numbers[1]),
          goal_(numbers.begin() + 2, numbers.end()) {}

    void on_data_available(DataReader* reader) override {
        JointState_ state;
        SampleInfo info;
        while (reader->take_next_sample(&state, &info) == ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data) continue;
            JointState_ command;
            command.header_(state.header_());
            for (size_t i = goal_.size(); i-- > 0;) {
                const double q = state.position_()[i], v = state.velocity_()[i];
                command.name_().push_back(state.name_()[i]);
                command.effort_().push_back(kp_ * (goal_[i] - q) - kd_ * v);
            }
            commands_->write(&command);
            ++count;
        }
    }

    int count = 0;

private:
    DataWriter* commands_;
    double kp_, kd_;
    std::vector<double> goal_;
};

class Discovery : public DomainParticipantListener {
public:
    void on_publisher_discovery(DomainParticipant*, WriterDiscoveryInfo&& found) override {
        if (found.status != WriterDiscoveryInfo::DISCOVERED_WRITER) return;
        const auto& data = found.info.m_qos.m_userData;
        print("[\"writer\"," + json(found.info.topicName().to_string()) + "," +
              json(found.info.typeName().to_string()) + "," +
              json(std::string(data.begin(), data.end())) + "]");
    }
};

static DomainParticipant* participant;

static Topic* topic(const std::string& name, TypeSupport type) {
    if (auto* known = participant->lookup_topicdescription("rt" + name))
        return static_cast<Topic*>(known);
    type.register_type(participant);
    return participant->create_topic("rt" + name, type.get_type_name(), TOPIC_QOS_DEFAULT);
}

template <class T>
static void listen(const std::string& name, TypeSupport type, bool latched = false,
                   DataReaderListener* listener = nullptr) {
    DataReaderQos qos;
    qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
    qos.history().kind = KEEP_ALL_HISTORY_QOS;
    if (latched) qos.durability().kind = TRANSIENT_LOCAL_DURABILITY_QOS;
    participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT)
        ->create_datareader(topic(name, type), qos, listener ? listener : new Printer<T>(name));
}

static DataWriter* talk(const std::string& name, TypeSupport type) {
    DataWriterQos qos;
    qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
    return participant->create_publisher(PUBLISHER_QOS_DEFAULT)
        ->create_datawriter(topic(name, type), qos, new Matched(name));
}

template <class T, class Value>
static void send(DataWriter* writer, Value value) {
    T message;
    message.data_(value);
    writer->write(&message);
}

static std::vector<std::string> list(const std::string& text) {
    std::vector<std::string> parts;
    std::istringstream all(text == "-" ? "" : text);
    for (std::string part; std::getline(all, part, ',');) parts.push_back(part);
    return parts;
}

static std::vector<double> numbers(const std::string& text) {
    std::vector<double> values;
    for (const std::string& part : list(text)) values.push_back(std::stod(part));
    return values;
}

static void command(DataWriter* writer, std::istringstream& words) {
    std::string times, stamp, names, q, v, tau;
    words >> times >> stamp >> names >> q >> v >> tau;
    JointState_ state;
    const long long at = std::stoll(stamp);
    state.header_().stamp_().sec_(at / 1000000000);
    state.header_().stamp_().nanosec_(at % 1000000000);
    state.name_(list(names));
    state.position_(numbers(q));
    state.velocity_(numbers(v));
    state.effort_(numbers(tau));
    for (int left = std::stoi(times); left > 0; --left) {
        writer->write(&state);
        if (left > 1) std::this_thread::sleep_for(std::chrono::microseconds(50));
    }
}

int main(int count, char** arguments) {
    std::vector<std::string> topics(arguments + 2, arguments + count);
    DomainParticipantQos qos;
    if (!topics.empty() && topics.front() == "--any") {
        topics.erase(topics.begin());
    } else {
        auto loopback = std::make_shared<UDPv4TransportDescriptor>();
        loopback->interfaceWhiteList.push_back("127.0.0.1");
        qos.transport().use_builtin_transports = false;
        qos.transport().user_transports.push_back(loopback);
    }
    auto* factory = DomainParticipantFactory::get_instance();
    Discovery discovery;
    participant = factory->create_participant(std::stoi(arguments[1]), qos, &discovery,
                                              StatusMask::none());
    std::map<std::string, DataWriter*> writers;
    std::map<std::string, std::string> types;
    Controller* controller = nullptr;
    for (auto it = topics.begin(); it != topics.end(); ++it) {
        using namespace geometry_msgs::msg::dds_;
        const auto equals = it->find('=');
        const std::string name = it->substr(0, equals);
        const std::string type = equals == std::string::npos ? "" : it->substr(equals + 1);
        TypeSupport state(new sensor_msgs::msg::dds_::JointState_PubSubType);
        types[name] = type;
        if (name == "--control") {
            std::vector<double> gains;
            for (auto given = it + 3; given != topics.end(); ++given)
                gains.push_back(std::stod(*given));
            controller = new Controller(talk(it[2], state), gains);
            listen<JointState_>(it[1], state, false, controller);
            break;
        } else if (type == "command")
            writers[name] = talk(name, state);
        else if (type == "bool")
            writers[name] = talk(name, TypeSupport(new std_msgs::msg::dds_::Bool_PubSubType));
        else if (type == "uint")
            writers[name] = talk(name, TypeSupport(new std_msgs::msg::dds_::UInt32_PubSubType));
        else if (type == "clock")
            listen<Clock_>(name, TypeSupport(new rosgraph_msgs::msg::dds_::Clock_PubSubType));
        else if (type == "state" || name.rfind("/joint_states", 0) == 0)
            listen<JointState_>(name, state);
        else if (name == "/robot_description")
            listen<String_>(name, TypeSupport(new std_msgs::msg::dds_::String_PubSubType), true);
        else if (name == "/tf" || name == "/tf_static")
            listen<TFMessage_>(name, TypeSupport(new tf2_msgs::msg::dds_::TFMessage_PubSubType),
                               name == "/tf_static");
        else if (name == "/target" || name == "/end_effector")
            listen<PointStamped_>(name, TypeSupport(new PointStamped_PubSubType));
        else
            writers[name] = talk(name, TypeSupport(new PointStamped_PubSubType));
    }
    for (std::string line; std::getline(std::cin, line);) {
        std::istringstream words(line);
        std::string name, frame, x, y, z;
        words >> name;
        print("[\"sent\"," + json(name) + "," + now() + "]");
        const std::string type = types.at(name);
        if (type == "command") {
            command(writers.at(name), words);
            continue;
        }
        words >> frame;
        if (type == "bool") {
            send<Bool_>(writers.at(name), frame == "true");
            continue;
        }
        if (type == "uint") {
            send<UInt32_>(writers.at(name), std::stoul(frame));
            continue;
        }
        words >> x >> y >> z;
        PointStamped_ point;
        point.header_().frame_id_(frame == "-" ? "" : frame);
        point.point_().x_(std::stod(x));
        point.point_().y_(std::stod(y));
        point.point_().z_(std::stod(z));
        writers.at(name)->write(&point);
    }
    if (controller) print("[\"controlled\"," + std::to_string(controller->count) + "]");
    for (auto& writer : writers) writer.second->wait_for_acknowledgments({2, 0});
    participant->delete_contained_entities();
    factory->delete_participant(participant);
}
