void vTaskDelay(int ticks);
